"""Bake Back to Keys operator: write the simulated motion of rigid bodies to the keys of their objects."""

import bpy

from ..r5dgs_addon.motion import bake_back, hand_over, simplify
from ..r5dgs_addon.ui import plural
from ..r5dgs_core import errors


class R5DGS_OT_bake_back(bpy.types.Operator):
    """Simulate to the end of the frame range, write the motion to keys, and remove the rigid bodies"""

    bl_idname = "r5dgs.bake_back"
    bl_label = "Bake Back to Keys"
    bl_options = {"REGISTER", "UNDO"}

    tolerance: simplify.TOLERANCE

    @classmethod
    def poll(cls, context):
        if hand_over.proxies_of(context.scene) is None:
            cls.poll_message_set("Hand objects over to rigid bodies first")
            return False
        return True

    def execute(self, context):
        try:
            anchors = bake_back.bake(context, self.tolerance)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        names = ", ".join(anchor.name for anchor in anchors)
        self.report({"INFO"}, f"{names}: {plural.of(simplify.key_count(anchors), 'key')}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_bake_back,)
