"""Brush Gaussians operator: select single Gaussians under a brush."""

import bpy
from bpy.props import IntProperty

from ..r5dgs_addon.clean_up import stroke_operator


class R5DGS_OT_brush_gaussians(stroke_operator.StrokeOperator, bpy.types.Operator):
    """Select the Gaussians under a brush while the left mouse button is pressed"""

    bl_idname = "r5dgs.brush_gaussians"
    bl_label = "Brush Gaussians"
    bl_options = {"REGISTER", "UNDO"}

    radius: IntProperty(
        name="Radius", description="Radius of the brush in pixels", default=25, min=1, soft_max=200, subtype="PIXEL"
    )


CLASSES = (R5DGS_OT_brush_gaussians,)
