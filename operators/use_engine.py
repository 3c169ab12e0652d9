"""Use R5DGS Engine: choose the render engine, and colour management that gives the colours back as trained."""

import bpy

from ..r5dgs_addon import engine, engine_color


class R5DGS_OT_use_engine(bpy.types.Operator):
    """Render with the engine R5DGS, and set the view transform to Standard, so that colors come out as trained"""

    bl_idname = "r5dgs.use_engine"
    bl_label = "Use R5DGS Engine"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        context.scene.render.engine = engine.ENGINE
        objections = engine_color.objections(context.scene)
        engine_color.show_as_trained(context.scene)
        self.report({"INFO"}, f"Engine R5DGS{'; replaced ' + ', '.join(objections) if objections else ''}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_use_engine,)
