"""Simplify Keys operator: reduce keys within a tolerance, for manual editing."""

import bpy

from ..r5dgs_addon.motion import duplicate_delete, simplify
from ..r5dgs_addon.ui import plural
from ..r5dgs_core import errors


class R5DGS_OT_simplify_keys(bpy.types.Operator):
    """Reduce the keys of the selected objects within a tolerance of their motion, for editing by hand"""

    bl_idname = "r5dgs.simplify_keys"
    bl_label = "Simplify Keys"
    bl_options = {"REGISTER", "UNDO"}

    tolerance: simplify.TOLERANCE

    @classmethod
    def poll(cls, context):
        return duplicate_delete.poll_chosen(cls, context)

    def execute(self, context):
        try:
            before, after = simplify.simplify(duplicate_delete.chosen(context), self.tolerance)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Reduced {plural.of(before, 'key')} to {after:,}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_simplify_keys,)
