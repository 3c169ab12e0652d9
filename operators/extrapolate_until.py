"""Extrapolate Until operator: extend or shorten the extrapolation of a loaded scene."""

import bpy
from bpy.props import BoolProperty, FloatProperty

from ..r5dgs_addon.motion import extrapolate, physics
from ..r5dgs_addon.scene import loaded_scenes, polls
from ..r5dgs_addon.ui import plural
from ..r5dgs_core import errors


class R5DGS_OT_extrapolate_until(polls.NeedsScene, bpy.types.Operator):
    """Extend or shorten the extrapolation of the whole scene, using edited physics and keeping keys edited by hand"""

    bl_idname = "r5dgs.extrapolate_until"
    bl_label = "Extrapolate Until"
    bl_options = {"REGISTER", "UNDO"}

    t_end: FloatProperty(name="Scene Time", description="Scene time of the last keys", precision=3, step=10)
    fit_timeline: BoolProperty(
        name="Fit Timeline", description="Set the end of the frame range to the last keys", default=True
    )

    def invoke(self, context, event):
        self.t_end = loaded_scenes.active_collection(context).r5dgs.t_end
        return context.window_manager.invoke_props_dialog(self)

    def execute(self, context):
        collection = loaded_scenes.active_collection(context)
        t_end = self.t_end if self.properties.is_property_set("t_end") else collection.r5dgs.t_end
        if t_end < collection.r5dgs.t_max:
            self.report(
                {"WARNING"},
                f"Nothing extrapolated: {t_end:g} is before the last observed time {collection.r5dgs.t_max:g}",
            )
        try:
            written, kept = extrapolate.extrapolate_until(context, collection, t_end, self.fit_timeline)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if kept:
            names = ", ".join(anchor.name for anchor in kept)
            self.report({"WARNING"}, f"Kept later keys edited by hand: {names}; Re-Extrapolate replaces them")
        too_fast = physics.too_fast(written)
        if too_fast:
            self.report({"WARNING"}, too_fast)
        self.report({"INFO"}, f"{plural.of(len(written), 'object', 'move')} until {collection.r5dgs.t_end:g}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_extrapolate_until,)
