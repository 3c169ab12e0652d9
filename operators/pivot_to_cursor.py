"""Pivot to 3D Cursor operator: set the pivot of the active object's motion to the 3D cursor."""

import bpy

from ..r5dgs_addon.motion import duplicate_delete, motion_fields, physics, pivot
from ..r5dgs_core import errors


class R5DGS_OT_pivot_to_cursor(bpy.types.Operator):
    """Make the active object turn or swing about the 3D cursor past the last observed time"""

    bl_idname = "r5dgs.pivot_to_cursor"
    bl_label = "Pivot to 3D Cursor"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if duplicate_delete.active_anchor(context) is None:
            cls.poll_message_set("Select an object of an R5DGS scene first")
            return False
        return True

    def execute(self, context):
        anchor = duplicate_delete.active_anchor(context)
        try:
            pivot.move(anchor, pivot.to_parent(anchor, context.scene.cursor.location))
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        motion_fields.write_at_once(anchor.r5dgs_motion, context)
        then = "" if physics.is_written(anchor) else "; Re-Extrapolate writes it to the keys"
        self.report({"INFO"}, f"{anchor.name}: pivot at the 3D cursor{then}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_pivot_to_cursor,)
