"""Reset Color operator: remove the tint of the selected objects."""

import bpy

from ..r5dgs_addon.scene import object_names, object_tint, selection
from . import recolor


class R5DGS_OT_reset_color(bpy.types.Operator):
    """Remove the tint of the selected objects"""

    bl_idname = "r5dgs.reset_color"
    bl_label = "Reset Color"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if not any(
            object_tint.is_tinted(cloud) for item in selection.selected(context) for cloud in object_names.clouds(*item)
        ):
            cls.poll_message_set("Select a tinted object first")
            return False
        return True

    def execute(self, context):
        return recolor.tint(self, context, object_tint.NONE)


CLASSES = (R5DGS_OT_reset_color,)
