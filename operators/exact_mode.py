"""Exact Mode: play what bends while observed."""

import bpy
from bpy.props import EnumProperty

from ..r5dgs_addon.motion import exact_mode
from ..r5dgs_addon.scene import loaded_scenes, polls
from ..r5dgs_addon.ui import plural
from ..r5dgs_core import errors

ACTIONS = (
    ("TOGGLE", "Toggle", "On where it is off, and off where it is on"),
    ("ON", "On", "Play what bends"),
    ("OFF", "Off", "Move objects as wholes"),
)


class R5DGS_OT_exact_mode(polls.NeedsScene, bpy.types.Operator):
    """Play points that bend before the last observed time, read from the scene file on every frame change"""

    bl_idname = "r5dgs.exact_mode"
    bl_label = "Exact Mode"
    bl_options = {"REGISTER", "UNDO"}

    action: EnumProperty(name="Action", description="What to do", items=ACTIONS)

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
            self.report({"INFO"}, f"{collection.name}: objects move as wholes")
            return {"FINISHED"}
        try:
            count = exact_mode.switch_on(context, collection)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report(
            {"INFO"}, f"{plural.of(count, 'Gaussian', 'bend')}; Lock Interface is on, so that renders stay in step"
        )
        return {"FINISHED"}


CLASSES = (R5DGS_OT_exact_mode,)
