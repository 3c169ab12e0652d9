"""Recolor operator: tint the selected objects of loaded scenes; white removes the tint."""

import bpy
from bpy.props import FloatVectorProperty

from ..r5dgs_addon.scene import object_names, object_tint, selection


def tint(operator: bpy.types.Operator, context: bpy.types.Context, factors) -> set[str]:
    """Tint the selected objects and report linked ones, which cannot change. Returns the operator's result."""
    wanted = [cloud for item in selection.selected(context) for cloud in object_names.clouds(*item)]
    linked = object_tint.recolor(wanted, factors)
    if linked:
        operator.report(
            {"WARNING"},
            f"Linked from another file; first make a library override of: {', '.join(linked)}",
        )
    return {"CANCELLED"} if len(linked) == len(wanted) else {"FINISHED"}


class R5DGS_OT_recolor(bpy.types.Operator):
    """Multiply the colors of the selected objects in the viewport, previews, renders and exports"""

    bl_idname = "r5dgs.recolor"
    bl_label = "Recolor"
    bl_options = {"REGISTER", "UNDO"}

    tint: FloatVectorProperty(
        name="Tint",
        description="Color that multiplies the Gaussians; white keeps the captured colors",
        subtype="COLOR_GAMMA",
        size=3,
        default=object_tint.NONE,
        min=0.0,
        soft_max=1.0,
        max=8.0,
    )

    @classmethod
    def poll(cls, context):
        if not selection.selected(context):
            cls.poll_message_set("Select an object of a loaded scene first")
            return False
        return True

    def execute(self, context):
        return tint(self, context, self.tint)


CLASSES = (R5DGS_OT_recolor,)
