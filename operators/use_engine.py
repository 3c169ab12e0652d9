"""Use R5DGS Engine: choose the render engine, and colour management that gives the colours back as trained."""

import bpy
from bpy.props import BoolProperty

from ..r5dgs_addon import engine, engine_color


class R5DGS_OT_use_engine(bpy.types.Operator):
    """Render with the engine R5DGS, and set the view transform to Standard, which shows all colors as trained"""

    bl_idname = "r5dgs.use_engine"
    bl_label = "Use R5DGS Engine"
    bl_options = {"REGISTER", "UNDO"}

    keep_view: BoolProperty(
        name="Keep View Transform",
        description="Leave AgX or what else is set to what is rendered beside; the engine inverts it for Gaussians, "
        "except colors that are too saturated for it",
        default=False,
    )

    def execute(self, context):
        context.scene.render.engine = engine.ENGINE
        replaced = []
        if not self.keep_view:
            replaced = engine_color.differences(context.scene)
            engine_color.show_as_trained(context.scene)
        self.report({"INFO"}, f"Engine R5DGS{'; replaced ' + ', '.join(replaced) if replaced else ''}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_use_engine,)
