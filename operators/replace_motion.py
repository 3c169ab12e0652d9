"""Copy Motion From Active operator: selected objects take over the motion of the active one."""

import bpy
from bpy.props import EnumProperty

from ..r5dgs_addon.motion import duplicate_delete, extrapolate, replace
from ..r5dgs_core import errors

STAYS = (
    ("LAST", "Last Observed Time", "Keep the pose at the last observed time"),
    ("FIRST", "First Observed Time", "Keep the pose at the first observed time"),
    ("CURRENT", "Current Frame", "Keep the pose at the current frame"),
)


class R5DGS_OT_replace_motion(bpy.types.Operator):
    """Copy the motion of the active object to the selected ones, each from its own place and about its own pivot"""

    bl_idname = "r5dgs.replace_motion"
    bl_label = "Copy Motion From Active"
    bl_options = {"REGISTER", "UNDO"}

    stays: EnumProperty(name="In Place At", description="Time at which the objects keep their pose", items=STAYS)

    @classmethod
    def poll(cls, context):
        source = duplicate_delete.active_anchor(context)
        if source is None or not [anchor for anchor in duplicate_delete.chosen(context) if anchor != source]:
            cls.poll_message_set("Select the objects to change, then the object whose motion they copy")
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
