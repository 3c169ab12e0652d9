"""Retime operator: play objects slower, faster, backward, held or repeated."""

import bpy
from bpy.props import EnumProperty, FloatProperty

from ..r5dgs_addon.motion import retime
from ..r5dgs_addon.scene import loaded_scenes, polls
from ..r5dgs_addon.ui import plural
from ..r5dgs_core import errors


class R5DGS_OT_retime(polls.NeedsScene, bpy.types.Operator):
    """Retime objects by a curve, observed and predicted motion alike. Their keys stay as they are"""

    bl_idname = "r5dgs.retime"
    bl_label = "Retime"
    bl_options = {"REGISTER", "UNDO"}

    kind: EnumProperty(name="Retiming", description="Curve to apply", items=retime.KINDS)
    which: EnumProperty(name="Objects", description="Objects to retime", items=retime.WHICH)
    speed: FloatProperty(
        name="Speed",
        description="Speed in percent of the original",
        default=50.0,
        min=1.0,
        soft_max=400.0,
        precision=1,
        subtype="PERCENTAGE",
    )
    hold: FloatProperty(
        name="Hold", description="Number of frames to hold", default=24.0, min=0.0, soft_max=250.0, subtype="TIME"
    )

    @classmethod
    def poll(cls, context):
        if context.mode != "OBJECT":
            cls.poll_message_set("Switch to Object Mode first")
            return False
        return super().poll(context)

    def execute(self, context):
        collection = loaded_scenes.active_collection(context)
        wanted = retime.anchors(context, collection, self.which)
        if not wanted:
            self.report({"ERROR"}, "Nothing to retime: select objects that move, or choose Whole Scene")
            return {"CANCELLED"}
        try:
            retime.apply(context, collection, wanted, self.kind, speed=self.speed / 100, hold=self.hold)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{plural.of(len(wanted), 'motion')} retimed")
        return {"FINISHED"}

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(self, "kind")
        layout.prop(self, "which")
        if self.kind == "SPEED":
            layout.prop(self, "speed")
        if self.kind == "HOLD":
            layout.prop(self, "hold")


CLASSES = (R5DGS_OT_retime,)
