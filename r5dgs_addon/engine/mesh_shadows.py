"""Shadows between Gaussians and merged meshes: proxies of the Gaussians, rendered by Cycles.

The scene of the meshes gets a collection of proxies: the convex hull of each body of Gaussians, stored in the scene
file or computed here, which follows the body's anchor, and the visible surface of the background. In the first view
layer the proxies are invisible to the camera and cast shadows on the meshes. In a second view layer they are shadow
catchers, the meshes are invisible to the camera, and the pass *Shadow Catcher* is the factor by which the meshes
darken the Gaussians.
"""

from collections.abc import Sequence
from dataclasses import replace

import bpy
import numpy as np

from ...r5dgs_core.scene import cameras
from ...r5dgs_core.shapes import depth_surface
from .. import compat
from ..scene import hull_meshes, loaded_scenes, presence_keys
from ..worker import jobs
from . import mesh_merge, render_request, view_cameras, visible_clouds

NAME = f"{mesh_merge.NAME} Shadows"
LONGEST = 240  # pixels of the longer side of the pictures of the background
MAX_VIEWS = 5  # pictures of the background along the path of the camera
SOLID = 0.9  # minimum alpha of pixels of the background's surface


def views(context: bpy.types.Context) -> list[render_request.VisibleParts]:
    """Return the background as the camera sees it: at the current frame, and along its path if it moves."""
    scene = context.scene
    frame, subframe = scene.frame_current, scene.frame_subframe
    ends = np.linspace(scene.frame_start, scene.frame_end, MAX_VIEWS - 1).round().astype(int)
    found = [_background(context)]
    try:
        for other in dict.fromkeys(ends.tolist()):
            scene.frame_set(other)
            view = _background(context)
            if not any(_is_same(view.camera, one.camera) for one in found):
                found.append(view)
    finally:
        scene.frame_set(frame, subframe=subframe)
    return found


def _background(context: bpy.types.Context) -> render_request.VisibleParts:
    """Return the Gaussians without an object, seen by the active camera in a small picture."""
    depsgraph = context.evaluated_depsgraph_get()
    parts = render_request.shown(depsgraph, lambda points: view_cameras.of_camera(depsgraph, points, border=False))
    camera = parts.camera
    factor = min(LONGEST / max(camera.width, camera.height), 1.0)
    size = (max(round(side * factor), 1) for side in (camera.width, camera.height))
    view = replace(parts.view, camera=cameras.resize(camera, *size))
    return replace(parts, view=view, instances=tuple(one for one in parts.instances if one.object.r5dgs.object_id <= 0))


def _is_same(camera: cameras.Camera, other: cameras.Camera) -> bool:
    return np.allclose(camera.T_cam_world, other.T_cam_world, atol=1e-5) and np.allclose(
        camera.intrinsics, other.intrinsics
    )


def start_depths(background: Sequence[render_request.VisibleParts]) -> jobs.Job:
    """Start rendering the depths of `views`. Pass the job's answers to `add`."""
    steps = [step for one in background for step in render_request.steps(one, ("depth", "alpha"), sky=False)]
    return jobs.start(steps)


def add(
    scene: bpy.types.Scene,
    clouds: Sequence[visible_clouds.VisibleCloud],
    background: Sequence[render_request.VisibleParts],
    pictures: Sequence[dict[str, np.ndarray]],
) -> bpy.types.Collection:
    """Create the proxies, the view layer of the shadows and its node, replacing those of an earlier call.

    Args:
        scene: Blender scene that is merged with meshes by Cycles.
        clouds: Visible point clouds of the scene, also those that are absent at the current frame.
        background: Result of `views`.
        pictures: Arrays ``depth`` and ``alpha`` of each view.

    Returns:
        The collection of the proxies.
    """
    remove(scene)
    meshes = mesh_merge.of(scene)
    assert meshes is not None
    proxies = bpy.data.collections.new(NAME)
    meshes.collection.children.link(proxies)
    for cloud in bodies(clouds):
        _add_hull(proxies, cloud)
    for parts, arrays in zip(background, pictures, strict=True):
        _add_surface(proxies, parts.view, arrays)
    _add_layer(meshes, proxies)
    _add_node(scene, meshes)
    return proxies


def bodies(clouds: Sequence[visible_clouds.VisibleCloud]) -> list[visible_clouds.VisibleCloud]:
    """Return the clouds that cast shadows: those of bodies, and all of scenes that an earlier version loaded."""
    marked = {cloud.collection for cloud in clouds if loaded_scenes.HULL in cloud.object}
    return [
        cloud
        for cloud in clouds
        if cloud.object.r5dgs.object_id > 0
        and cloud.parent is None
        and (loaded_scenes.HULL in cloud.object or cloud.collection not in marked)
    ]


def remove(scene: bpy.types.Scene) -> None:
    """Undo `add`."""
    meshes, tree = mesh_merge.of(scene), compat.compositor(scene)
    if tree is not None and NAME in tree.nodes:
        tree.nodes.remove(tree.nodes[NAME])
    if meshes is None:
        return
    if NAME in meshes.view_layers:
        meshes.view_layers.remove(meshes.view_layers[NAME])
    for proxies in [one for one in meshes.collection.children if one.name.startswith(NAME)]:
        data = [obj.data for obj in proxies.objects]
        bpy.data.batch_remove([*proxies.objects, *data, proxies])


def _add_hull(proxies: bpy.types.Collection, visible: visible_clouds.VisibleCloud) -> None:
    """Add the convex hull of a point cloud as its child, so that it follows the cloud's motion and visibility."""
    cloud = visible.object
    corners = hull_meshes.corners(cloud, stored=visible.edit is None)
    data = hull_meshes.new_mesh(f"{cloud.name} shadow proxy", corners)
    if data is not None:
        proxy = _new_proxy(proxies, data)
        proxy.parent = cloud
        presence_keys.follow(proxy, cloud)


def _add_surface(proxies: bpy.types.Collection, view: view_cameras.ViewCamera, arrays: dict[str, np.ndarray]) -> None:
    """Add the surface that a view of the background shows. It receives shadows; it neither casts nor reflects light.

    A gray surface below a mesh would brighten it: the PSNR of a mesh on the demo's table falls from 33 to 28 dB.
    """
    depths = np.where(arrays["alpha"] >= SOLID, arrays["depth"] + view.distance, np.inf)
    vertices, triangles = depth_surface.triangulate(view.camera, depths)
    if not len(triangles):
        return
    data = bpy.data.meshes.new("background shadow proxy")
    data.from_pydata(vertices, (), triangles)
    data.shade_smooth()
    surface = _new_proxy(proxies, data)
    surface.visible_diffuse = surface.visible_shadow = False


def _new_proxy(proxies: bpy.types.Collection, data: bpy.types.Mesh) -> bpy.types.Object:
    """Add a shadow catcher that no mirror or glass shows."""
    proxy = bpy.data.objects.new(data.name, data)
    proxy.is_shadow_catcher = True
    proxy.visible_glossy = proxy.visible_transmission = False
    proxies.objects.link(proxy)
    return proxy


def _add_layer(meshes: bpy.types.Scene, proxies: bpy.types.Collection) -> None:
    """Add the view layer that shows the proxies alone, and hide them from the camera in the first one."""
    first, layer = meshes.view_layers[0], meshes.view_layers.new(NAME)
    layer.cycles.use_pass_shadow_catcher = True
    for view_layer in (first, layer):
        view_layer.update()  # Blender 5.2 creates the layer collections of linked collections here
    for given, own in zip(first.layer_collection.children, layer.layer_collection.children, strict=True):
        if given.collection == proxies:
            given.indirect_only = True
        else:
            own.exclude, own.indirect_only = given.exclude, True
            mesh_merge.share_visibility(given, own)
    layer.update_render_passes()


def _add_node(scene: bpy.types.Scene, meshes: bpy.types.Scene) -> None:
    """Connect the pass of the shadows with the node group of the merge."""
    tree = compat.compositor(scene)
    merge = tree.nodes[mesh_merge.NAME]
    node = tree.nodes.new("CompositorNodeRLayers")
    node.scene, node.layer = meshes, NAME
    node.name = node.label = NAME
    node.location = merge.location[0] - 300, merge.location[1] - 720
    tree.links.new(node.outputs["Shadow Catcher"], merge.inputs["Shadows"])
