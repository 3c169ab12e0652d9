"""Reset to Learned: bring the motion of the selected objects back to what the scene file says."""

import bpy
from bpy.props import BoolProperty

from ..r5dgs_addon.engine import render_request
from ..r5dgs_addon.motion import duplicate_delete, extrapolate
from ..r5dgs_core import errors


class R5DGS_OT_reset_motion(bpy.types.Operator):
    """Bring the physics of the selected objects, and the keys after the last observed time, back to the learned ones"""

    bl_idname = "r5dgs.reset_motion"
    bl_label = "Reset to Learned"
    bl_options = {"REGISTER", "UNDO"}

    observed: BoolProperty(
        name="Observed Keys Too",
        description="Read the keys up to the last observed time from the scene file again, in place of yours",
        default=False,
    )

    @classmethod
    def poll(cls, context):
        return duplicate_delete.poll_chosen(cls, context)

    def execute(self, context):
        anchors = duplicate_delete.chosen(context)
        try:
            if self.observed:  # all of it is there and can be written before any of it is
                extrapolate.check(anchors, curves=False)
                members = duplicate_delete.by_scene(anchors)
                sources = [
                    extrapolate.source(own, render_request.scene_path(collection))
                    for collection, own in members.items()
                ]
                for own, scene in zip(members.values(), sources, strict=True):
                    extrapolate.reload(own, scene)
            extrapolate.reset(anchors)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Learned motion: {', '.join(anchor.name for anchor in anchors)}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_reset_motion,)
