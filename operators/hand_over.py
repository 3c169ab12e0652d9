"""Hand Over to Rigid Bodies operator: Blender's physics continues the motion of the selected objects."""

import math

import bpy
from bpy.props import EnumProperty

from ..r5dgs_addon.motion import duplicate_delete, extrapolate, hand_over
from ..r5dgs_core import errors

STARTS = (
    ("LAST", "Last Observed Time", "Simulate from the last observed frame on"),
    ("CURRENT", "Current Frame", "Simulate from the current frame on"),
)
_ROUNDING = 1e-6  # of frame numbers


class R5DGS_OT_hand_over(bpy.types.Operator):
    """Let Blender's rigid bodies continue the motion of the selected objects, so that they collide with meshes"""

    bl_idname = "r5dgs.hand_over"
    bl_label = "Hand Over to Rigid Bodies"
    bl_options = {"REGISTER", "UNDO"}

    start: EnumProperty(name="From", description="Frame from which the objects are simulated", items=STARTS)

    @classmethod
    def poll(cls, context):
        if hand_over.proxies_of(context.scene) is not None:
            cls.poll_message_set("Bake the rigid bodies back to keys first")
            return False
        return duplicate_delete.poll_chosen(cls, context)

    def execute(self, context):
        anchors = duplicate_delete.chosen(context)
        try:
            frame = context.scene.frame_current
            if self.start == "LAST":
                times = extrapolate.times_of(anchors[0])
                frame = math.floor(times.frame(times.t_max) + _ROUNDING)
            proxies = hand_over.hand_over(context, anchors, frame)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        names = ", ".join(obj.name for obj in proxies.objects if obj.type == "MESH")
        self.report({"INFO"}, f"Rigid bodies from frame {frame} on: {names}. Play from the start of the frame range")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_hand_over,)
