"""Cameras that captured a loaded scene, as Blender cameras in the collection *Cameras*."""

import bpy
import numpy as np
from mathutils import Matrix

from ...r5dgs_core.scene import cameras
from ...r5dgs_core.scene.scene import Scene
from . import first_view, object_names

COLLECTION = "Cameras"
SENSOR_MM = 36.0  # Blender's own width
DISPLAY_SIZE = 0.05  # of the scene's extent
CAPTURED = "r5dgs_captured"  # custom property of a camera: name in the data set, width, height and pixel aspect
FACTORY_PLACE = (7.3589, -6.9258, 4.9583)  # of the camera in Blender's factory settings


def build(
    context: bpy.types.Context, collection: bpy.types.Collection, root: bpy.types.Object, scene: Scene
) -> list[bpy.types.Object]:
    """Create the captured cameras of a loaded scene. Returns them in the order of the scene file.

    The collection is hidden in the viewport, because the lines from many cameras to their parents would cover the
    scene.
    """
    if not scene.cameras:
        return []
    home = bpy.data.collections.new(COLLECTION)
    collection.children.link(home)
    found = []
    for number, captured in enumerate(scene.cameras):
        name = object_names.fit(captured.name or f"camera {number + 1}")
        camera = bpy.data.objects.new(name, _data(name, captured))
        camera.data.display_size = DISPLAY_SIZE * scene.extent
        start, end = first_view.clip_range(first_view.distance(scene, captured))
        camera.data.clip_start, camera.data.clip_end = start, end
        aspect = float(captured.intrinsics[0, 0] / captured.intrinsics[1, 1])
        size = {"width": captured.width, "height": captured.height, "aspect": aspect}
        camera[CAPTURED] = {"name": captured.name or name, **size}
        camera.parent = root
        camera.matrix_basis = Matrix(cameras.cam_world_to_opengl(captured.T_cam_world).tolist())
        home.objects.link(camera)
        found.append(camera)
    layer = context.view_layer.layer_collection.children[collection.name]
    layer.children[home.name].hide_viewport = True
    if not is_own_camera_used(context.scene):
        best = first_view.best(scene)
        use(context.scene, found[best])
    return found


def all_of(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Captured cameras of a loaded scene; none for scenes that an earlier version loaded."""
    return [obj for obj in collection.all_objects if obj.type == "CAMERA" and CAPTURED in obj]


def name_of(camera: bpy.types.Object) -> str:
    """Name of a captured camera in its data set."""
    return str(camera[CAPTURED]["name"])


def use(scene: bpy.types.Scene, camera: bpy.types.Object) -> None:
    """Render a Blender scene from a captured camera, with its resolution and pixel aspect."""
    render, captured = scene.render, camera[CAPTURED]
    scene.camera = camera
    render.resolution_x, render.resolution_y = int(captured["width"]), int(captured["height"])
    render.resolution_percentage, aspect = 100, float(captured["aspect"])
    square = abs(aspect - 1) < 1e-3
    render.pixel_aspect_x, render.pixel_aspect_y = (1, 1) if square else (max(1 / aspect, 1), max(aspect, 1))


def is_own_camera_used(scene: bpy.types.Scene) -> bool:
    """Return True if a Blender scene has an active camera of the user's, other than that of the factory settings."""
    camera = scene.camera
    if camera is None:
        return False
    moved = camera.animation_data is not None or camera.parent is not None or len(camera.constraints) > 0
    return moved or not np.allclose(camera.location, FACTORY_PLACE, atol=1e-3)


def _data(name: str, captured: cameras.Camera) -> bpy.types.Camera:
    """Lens and sensor of a camera; Blender measures the shift in widths of the image."""
    data, k, width = bpy.data.cameras.new(name), captured.intrinsics, captured.width
    data.sensor_fit, data.sensor_width = "HORIZONTAL", SENSOR_MM
    data.sensor_height = SENSOR_MM * captured.height / width
    data.lens = k[0, 0] * SENSOR_MM / width
    data.shift_x = (width / 2 - k[0, 2]) / width
    data.shift_y = (k[1, 2] - captured.height / 2) / width * k[0, 0] / k[1, 1]
    return data
