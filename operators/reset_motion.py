"""Reset to Learned operator: restore the motion of the scene file."""

import bpy
from bpy.props import BoolProperty

from ..r5dgs_addon.engine import render_request
from ..r5dgs_addon.motion import duplicate_delete, extrapolate
from ..r5dgs_core import errors


class R5DGS_OT_reset_motion(bpy.types.Operator):
    """Reset the physics of the selected objects and the keys past the last observed time to the learned motion"""

    bl_idname = "r5dgs.reset_motion"
    bl_label = "Reset to Learned"
    bl_options = {"REGISTER", "UNDO"}

    observed: BoolProperty(
        name="Observed Keys Too",
        description="Replace the keys up to the last observed time by those of the scene file, too",
        default=False,
    )

    @classmethod
    def poll(cls, context):
        return duplicate_delete.poll_chosen(cls, context)

    def execute(self, context):
        anchors = duplicate_delete.chosen(context)
        try:
            if self.observed:  # read and check everything before writing
                extrapolate.check(anchors, curves=False)
                members = duplicate_delete.by_scene(anchors)
                sources = [
                    extrapolate.read_source(own, render_request.scene_path(collection))
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
