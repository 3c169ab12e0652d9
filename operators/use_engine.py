"""Use R5DGS Engine operator: choose the render engine, and report the colour loss under the view transform."""

import bpy

from ..r5dgs_addon.color import display_to_linear, inverse_loss
from ..r5dgs_addon.engine import engine

REMEDY = "'Show Colors as Trained' in the render properties sets the view transform to Standard, which shows all colors"


class R5DGS_OT_use_engine(bpy.types.Operator):
    """Render with the R5DGS engine, which inverts the current view transform for Gaussians"""

    bl_idname = "r5dgs.use_engine"
    bl_label = "Use R5DGS Engine"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        scene = context.scene
        scene.render.engine = engine.ENGINE
        loss = inverse_loss.measure(scene)
        objections = display_to_linear.objections(scene)
        view = scene.view_settings.view_transform
        if objections:
            self.report(
                {"WARNING"},
                f"Engine R5DGS; colors differ from the trained ones because of: {', '.join(objections)}; {REMEDY}",
            )
        elif loss is None:
            self.report({"INFO"}, "Engine R5DGS")
        elif loss.psnr < inverse_loss.ENOUGH_DB:
            self.report({"WARNING"}, f"Engine R5DGS; {view} is inverted, {inverse_loss.note(loss)}; {REMEDY}")
        else:
            self.report({"INFO"}, f"Engine R5DGS; {view} is inverted: {inverse_loss.note(loss)}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_use_engine,)
