"""*Capture* panel."""

import bpy

from . import sidebar


class R5DGS_PT_capture(sidebar.Sidebar, bpy.types.Panel):
    """Capture training data from this Blender scene."""

    bl_idname = "R5DGS_PT_capture"
    bl_label = "Capture"
    manual = "capture"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        return hasattr(bpy.types, "R5DGS_OT_capture_dataset")

    def draw(self, context):
        self.layout.operator("r5dgs.capture_dataset", text="Capture Data Set", icon="CAMERA_DATA")


CLASSES = (R5DGS_PT_capture,)
