"""Exact Mode operator: play the residual motion of single Gaussians."""

import bpy
from bpy.props import EnumProperty

from ..r5dgs_addon.motion import exact_mode
from ..r5dgs_addon.scene import loaded_scenes, polls
from ..r5dgs_addon.ui import plural
from ..r5dgs_core import errors

ACTIONS = (
    ("TOGGLE", "Toggle", "Toggle Exact Mode"),
    ("ON", "On", "Play the residual motion of single Gaussians"),
    ("OFF", "Off", "Move objects rigidly"),
)


class R5DGS_OT_exact_mode(polls.NeedsScene, bpy.types.Operator):
    """Play the residual motion of single Gaussians, read from the scene file at each frame change"""

    bl_idname = "r5dgs.exact_mode"
    bl_label = "Exact Mode"
    bl_options = {"REGISTER", "UNDO"}

    action: EnumProperty(name="Action", description="Change of the mode", items=ACTIONS)

    @classmethod
    def poll(cls, context):
        if context.mode != "OBJECT":
            cls.poll_message_set("Switch to Object Mode first")
            return False
        return super().poll(context)

    def execute(self, context):
        collection = loaded_scenes.active_collection(context)
        if self.action == "OFF" or (self.action == "TOGGLE" and collection.r5dgs_exact.enabled):
            exact_mode.switch_off(context, collection)
            self.report({"INFO"}, f"{collection.name}: objects move rigidly")
            return {"FINISHED"}
        try:
            count = exact_mode.switch_on(context, collection)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report(
            {"INFO"},
            f"{plural.of(count, 'Gaussian', 'bend')}; Lock Interface is on, so that renders show the right frame",
        )
        return {"FINISHED"}


CLASSES = (R5DGS_OT_exact_mode,)
