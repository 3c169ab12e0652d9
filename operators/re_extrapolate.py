"""Re-Extrapolate operator: rewrite the keys past the last observed time from the objects' physics."""

import bpy

from ..r5dgs_addon.motion import duplicate_delete, extrapolate, physics
from ..r5dgs_core import errors


class R5DGS_OT_re_extrapolate(bpy.types.Operator):
    """Rewrite the keys past the last observed time from the physics of the selected objects; earlier keys are kept"""

    bl_idname = "r5dgs.re_extrapolate"
    bl_label = "Re-Extrapolate"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        return duplicate_delete.poll_chosen(cls, context)

    def execute(self, context):
        try:
            written = extrapolate.re_extrapolate(duplicate_delete.chosen(context))
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        too_fast = physics.too_fast(written)
        if too_fast:
            self.report({"WARNING"}, too_fast)
        self.report({"INFO"}, f"Extrapolated {', '.join(anchor.name for anchor in written)}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_re_extrapolate,)
