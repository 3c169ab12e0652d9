"""Un-Isolate operator: restore the visibility before *Isolate*."""

import bpy

from ..r5dgs_addon.scene import isolation


class R5DGS_OT_unisolate(bpy.types.Operator):
    """Show the other objects again, except those hidden before"""

    bl_idname = "r5dgs.unisolate"
    bl_label = "Un-Isolate"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if not isolation.is_isolated(context.scene):
            cls.poll_message_set("Nothing is isolated")
            return False
        return True

    def execute(self, context):
        isolation.restore(context.scene)
        return {"FINISHED"}


CLASSES = (R5DGS_OT_unisolate,)
