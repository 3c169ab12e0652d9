"""Merging of meshes and Gaussians in one picture: a scene of the meshes for EEVEE or Cycles, and compositor nodes.

F12 of the scene with the Gaussians renders both scenes, as its compositor uses both. The merged picture is

    coverage * (shadows * front + visible * meshes) + (1 - coverage) * shadows * Gaussians

    coverage  anti-aliased coverage of the meshes
    meshes    their straight colours
    front     Gaussians in front of the meshes, premultiplied (pass `render_passes.FRONT`)
    visible   share of the meshes that these Gaussians let through (the same pass)
    shadows   shadows of the meshes on the Gaussians; 1 without `mesh_shadows`
"""

import bpy
from bpy.app.handlers import persistent

from .. import compat
from . import render_passes, visible_meshes

NAME = "R5DGS Merge"
SAMPLES = 128  # of Cycles, in a new scene
_INPUTS = (  # of the node group
    *(("Gaussians", "Color"), ("Front", "Color"), ("Shadows", "Color")),
    *(("Meshes", "Color"), ("Coverage", "Float")),
)
_SHARED = (
    *("resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y", "use_border"),
    *("border_min_x", "border_max_x", "border_min_y", "border_max_y", "use_crop_to_border", "fps", "fps_base"),
    *("use_motion_blur", "motion_blur_shutter", "motion_blur_position", "use_multiview", "views_format"),
)


def of(scene: bpy.types.Scene) -> bpy.types.Scene | None:
    """Scene of the meshes that are merged into a Blender scene, or None."""
    return scene.r5dgs_render.meshes


def add(scene: bpy.types.Scene, engine: str) -> bpy.types.Scene:
    """Create the scene of the meshes and the compositor nodes of a Blender scene.

    Args:
        scene: Scene with Gaussians and meshes.
        engine: Render engine of the meshes.

    Returns:
        The new scene. It shares the objects of ``scene``; loaded R5DGS scenes are excluded from it.
    """
    meshes = bpy.data.scenes.new(f"{scene.name} Meshes")
    meshes.world = scene.world
    meshes.render.engine, meshes.render.film_transparent = engine, True
    if hasattr(meshes, "cycles"):
        meshes.cycles.samples = SAMPLES
    scene.r5dgs_render.meshes = meshes
    _share_objects(scene, meshes)
    share_settings(scene, meshes)
    _add_nodes(scene, meshes)
    return meshes


def remove(scene: bpy.types.Scene) -> None:
    """Undo `add`; other nodes of the compositor stay, with their links."""
    meshes, tree = of(scene), compat.compositor(scene)
    scene.r5dgs_render.meshes = None
    if tree is not None:
        _remove_nodes(tree)
    for group in [one for one in bpy.data.node_groups if one.name.startswith(NAME) and not one.users]:
        bpy.data.node_groups.remove(group)
    if meshes is not None:
        own = [one for one in meshes.collection.children if one.name.startswith(NAME)]
        compat.remove_scene(meshes)
        bpy.data.batch_remove(own)


def share_settings(scene: bpy.types.Scene, meshes: bpy.types.Scene) -> None:
    """Copy the settings on which camera, size and time of a picture depend, with the markers that switch cameras."""
    for name in _SHARED:
        value = getattr(scene.render, name)
        if getattr(meshes.render, name) != value:
            setattr(meshes.render, name, value)
    meshes.camera = scene.camera
    meshes.frame_start, meshes.frame_end, meshes.frame_step = scene.frame_start, scene.frame_end, scene.frame_step
    meshes.timeline_markers.clear()
    for marker in scene.timeline_markers:
        if marker.camera is not None:
            meshes.timeline_markers.new(marker.name, frame=marker.frame).camera = marker.camera


def notes(scene: bpy.types.Scene) -> list[str]:
    """Meshes that are not merged, as a sentence without a period."""
    meshes = of(scene)
    if meshes is None:
        return []
    there = set(meshes.collection.all_objects)
    lost = [name for name in visible_meshes.names(scene) if bpy.data.objects[name] not in there]
    return [f"{', '.join(lost)}: not merged; press Merge with Meshes again"] if lost else []


def _share_objects(scene: bpy.types.Scene, meshes: bpy.types.Scene) -> None:
    """Link the collections and objects of a scene to another, and exclude the same collections and R5DGS scenes.

    Objects of the top level go to a new collection, because only collections can be hidden from cameras in a layer.
    """
    for child in scene.collection.children:
        meshes.collection.children.link(child)
    top = bpy.data.collections.new(f"{NAME} Objects")
    for obj in scene.collection.objects:
        top.objects.link(obj)
    meshes.collection.children.link(top)
    meshes.view_layers[0].update()  # Blender 5.2 creates the layer collections of linked collections here
    share_visibility(scene.view_layers[0].layer_collection, meshes.view_layers[0].layer_collection)


def share_visibility(source: bpy.types.LayerCollection, target: bpy.types.LayerCollection) -> None:
    """Exclude loaded R5DGS scenes, and copy the visibility of all other collections of ``source``."""
    for given, layer in zip(source.children, target.children, strict=False):  # only the target has its own objects
        if given.exclude or layer.collection.r5dgs.is_scene:
            layer.exclude = True
        else:
            layer.holdout, layer.indirect_only = given.holdout, given.indirect_only
            share_visibility(given, layer)


def _add_nodes(scene: bpy.types.Scene, meshes: bpy.types.Scene) -> None:
    """Insert the merge between the Render Layers node of a scene and the sockets that it feeds."""
    tree = compat.make_compositor(scene)
    source = next((node for node in tree.nodes if node.type == "R_LAYERS" and node.scene == scene), None)
    if source is None:
        source = tree.nodes.new("CompositorNodeRLayers")
        source.scene = scene
    fed = [link.to_socket for link in source.outputs["Image"].links] or [compat.compositor_output(tree)]
    other, merge = tree.nodes.new("CompositorNodeRLayers"), tree.nodes.new("CompositorNodeGroup")
    other.scene, merge.node_tree = meshes, _merge_group()
    other.name = other.label = f"{NAME}: Meshes"
    merge.name = merge.label = NAME
    x, y = source.location
    other.location, merge.location = (x, y - 420), (x + 300, y - 120)
    tree.links.new(source.outputs["Image"], merge.inputs["Gaussians"])
    tree.links.new(source.outputs[render_passes.FRONT.name], merge.inputs["Front"])
    tree.links.new(other.outputs["Image"], merge.inputs["Meshes"])
    tree.links.new(other.outputs["Alpha"], merge.inputs["Coverage"])
    for socket in fed:
        tree.links.new(merge.outputs[0], socket)


def _remove_nodes(tree: bpy.types.NodeTree) -> None:
    merge = tree.nodes.get(NAME)
    if merge is not None:
        sources = [link.from_socket for link in merge.inputs["Gaussians"].links]
        for socket in [link.to_socket for link in merge.outputs[0].links]:
            for source in sources:
                tree.links.new(source, socket)
    for node in [node for node in tree.nodes if node.name.startswith(NAME)]:
        tree.nodes.remove(node)


def _merge_group() -> bpy.types.NodeTree:
    """Node group that merges pictures as described above.

    With a foreground of alpha 0, the node *Alpha Over* adds foreground and background. `render_passes.FRONT` holds the
    visible part of the meshes as its alpha.
    """
    group = bpy.data.node_groups.new(NAME, "CompositorNodeTree")
    for name, kind in _INPUTS:
        group.interface.new_socket(name, in_out="INPUT", socket_type=f"NodeSocket{kind}")
    group.interface.items_tree["Shadows"].default_value = (1.0, 1.0, 1.0, 1.0)
    group.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    given, result = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    images = given.outputs
    gaussians, front = (compat.multiply(group, images[name], images["Shadows"]) for name in ("Gaussians", "Front"))
    visible = group.nodes.new("CompositorNodeSeparateColor")
    group.links.new(images["Front"], visible.inputs[0])
    covered = compat.set_alpha(group, "APPLY", front, images["Coverage"])
    added = compat.set_alpha(group, "REPLACE_ALPHA", covered, None)
    behind = compat.set_alpha(group, "APPLY", images["Meshes"], visible.outputs["Alpha"])
    both = compat.alpha_over(group, behind, added)
    foreground = compat.set_alpha(group, "REPLACE_ALPHA", both, images["Coverage"])
    group.links.new(compat.alpha_over(group, gaussians, foreground), result.inputs[0])
    for place, node in enumerate(group.nodes):
        node.location = (180 * place - 700, 0)
    given.location, result.location = (-1000, 0), (180 * len(group.nodes) - 700, 0)
    return group


@persistent
def _begin(scene, *_):
    """Copy the settings before a render, as they may have changed since `add`."""
    meshes = of(scene)
    if meshes is not None:
        share_settings(scene, meshes)


def register():
    """Register the handler of the start of renders."""
    bpy.app.handlers.render_init.append(_begin)


def unregister():
    """Undo `register`."""
    if _begin in bpy.app.handlers.render_init:
        bpy.app.handlers.render_init.remove(_begin)
