"""Use Captured Camera operator: render and look through a captured camera."""

import bpy
from bpy.props import EnumProperty

from ..r5dgs_addon.scene import captured_cameras, loaded_scenes, polls

_items: list[tuple[str, str, str]] = []  # Blender keeps no reference to the texts of dynamic items


def _cameras(_, context):
    collection = None if context is None else loaded_scenes.active_collection(context)
    found = [] if collection is None else captured_cameras.all_of(collection)
    _items[:] = [(one.name, one.name, f"Use the camera {one.name}") for one in found]
    return _items


class R5DGS_OT_use_captured_camera(polls.NeedsCapturedCameras, bpy.types.Operator):
    """Render from a captured camera with the resolution of its images, and look through it in this view"""

    bl_idname = "r5dgs.use_captured_camera"
    bl_label = "Use Captured Camera"
    bl_options = {"REGISTER", "UNDO"}

    camera: EnumProperty(name="Camera", description="Captured camera", items=_cameras)

    def execute(self, context):
        cameras = captured_cameras.all_of(loaded_scenes.active_collection(context))
        captured_cameras.use(context.scene, next(one for one in cameras if one.name == self.camera))
        if context.region_data is not None:
            context.region_data.view_perspective = "CAMERA"
        return {"FINISHED"}


CLASSES = (R5DGS_OT_use_captured_camera,)
