"""Show Colors as Trained operator: colour management that reproduces trained colours with any render engine."""

import bpy

from ..r5dgs_addon.color import display_to_linear


class R5DGS_OT_show_colors_as_trained(bpy.types.Operator):
    """Set the view transform to Standard, without look, exposure, gamma or curves"""

    bl_idname = "r5dgs.show_colors_as_trained"
    bl_label = "Show Colors as Trained"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        display_to_linear.show_as_trained(context.scene)
        return {"FINISHED"}


CLASSES = (R5DGS_OT_show_colors_as_trained,)
