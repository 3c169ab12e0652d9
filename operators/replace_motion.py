"""Replace Motion: the selected objects move as the active one does."""

import bpy
from bpy.props import EnumProperty

from ..r5dgs_addon.motion import duplicate_delete, extrapolate, replace
from ..r5dgs_core import errors

STAYS = (
    ("LAST", "Last Observed Time", "They stay where they are at the last observed time"),
    ("FIRST", "First Observed Time", "They stay where they are at the first observed time"),
    ("CURRENT", "Current Frame", "They stay where they are at the current frame"),
)


class R5DGS_OT_replace_motion(bpy.types.Operator):
    """Let the selected objects move as the active one does, each from its own place and about its own pivot"""

    bl_idname = "r5dgs.replace_motion"
    bl_label = "Copy Motion From Active"
    bl_options = {"REGISTER", "UNDO"}

    stays: EnumProperty(name="In Place At", description="When the objects are where they were", items=STAYS)

    @classmethod
    def poll(cls, context):
        source = duplicate_delete.active_anchor(context)
        if source is None or not [anchor for anchor in duplicate_delete.chosen(context) if anchor != source]:
            cls.poll_message_set("Select the objects that shall move, and last the one that they shall move like")
            return False
        return True

    def execute(self, context):
        source = duplicate_delete.active_anchor(context)
        targets = [anchor for anchor in duplicate_delete.chosen(context) if anchor != source]
        try:
            plans = []
            for target in targets:
                times = extrapolate.times_of(target)
                frame = {
                    "LAST": times.frame(times.t_max),
                    "FIRST": times.frame(times.t_start),
                    "CURRENT": context.scene.frame_current_final,
                }[self.stays]
                plans.append(replace.prepare(target, source, frame, times))
            extrapolate.check(targets)
            for plan in plans:
                replace.apply(plan)
            extrapolate.re_extrapolate(extrapolate.followers(targets))
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        context.view_layer.update()
        names = ", ".join(anchor.name for anchor in targets)
        self.report({"INFO"}, f"{names}: moving like {source.name}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_replace_motion,)
