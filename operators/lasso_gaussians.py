"""Lasso Gaussians operator: select single Gaussians inside a path."""

import bpy

from ..r5dgs_addon.clean_up import stroke_operator


class R5DGS_OT_lasso_gaussians(stroke_operator.StrokeOperator, bpy.types.Operator):
    """Select the Gaussians inside a lasso that is drawn with the left mouse button"""

    bl_idname = "r5dgs.lasso_gaussians"
    bl_label = "Lasso Gaussians"
    bl_options = {"REGISTER", "UNDO"}


CLASSES = (R5DGS_OT_lasso_gaussians,)
