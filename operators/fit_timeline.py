"""Fit Timeline operator: set frame range and markers for a scene that was appended or linked."""

import bpy

from ..r5dgs_addon.motion import event_markers
from ..r5dgs_addon.scene import loaded_scenes, polls, timeline


class R5DGS_OT_fit_timeline(polls.NeedsScene, bpy.types.Operator):
    """Set the frame range to that of the loaded scene, and mark its last observed time and its events"""

    bl_idname = "r5dgs.fit_timeline"
    bl_label = "Fit Timeline"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        times = timeline.of_collection(loaded_scenes.active_collection(context))
        timeline.fit(context.scene, times)
        event_markers.show(context.scene, loaded_scenes.active_collection(context))
        frames = f"{context.scene.frame_start} to {context.scene.frame_end}"
        self.report({"INFO"}, f"Frames {frames}, observed until {round(times.frame(times.t_max))}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_fit_timeline,)
