"""Delete Object operator: delete objects of a scene with everything that belongs to them."""

import bpy
from bpy.props import BoolProperty

from ..r5dgs_addon.motion import duplicate_delete
from ..r5dgs_core import errors


class R5DGS_OT_delete_object(bpy.types.Operator):
    """Delete the selected objects with their anchors, points, keys and emptied collections"""

    bl_idname = "r5dgs.delete_object"
    bl_label = "Delete Object"
    bl_options = {"REGISTER", "UNDO"}

    shadows: BoolProperty(name="Shadows", description="Delete the shadows of the objects, too", default=True)

    @classmethod
    def poll(cls, context):
        return duplicate_delete.poll_chosen(cls, context)

    def execute(self, context):
        try:
            _, names = duplicate_delete.delete(context, duplicate_delete.chosen(context), self.shadows)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Deleted {', '.join(names)}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_delete_object,)
