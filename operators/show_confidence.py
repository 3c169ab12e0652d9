"""Show Confidence operator: show the uncertainty of extrapolated paths as tubes."""

import bpy
from bpy.props import EnumProperty

from ..r5dgs_addon.motion import confidence_tubes, duplicate_delete, extrapolate, physics
from ..r5dgs_addon.scene import loaded_scenes, polls
from ..r5dgs_addon.ui import plural
from ..r5dgs_core import errors

ACTIONS = (
    ("TOGGLE", "Toggle", "Remove existing tubes, otherwise create them"),
    ("SHOW", "Show", "Create or update the tubes"),
    ("HIDE", "Hide", "Remove the tubes"),
)


class R5DGS_OT_show_confidence(polls.NeedsScene, bpy.types.Operator):
    """Show the 95 % confidence bands of the extrapolated paths of the selected objects, or of all, as tubes"""

    bl_idname = "r5dgs.show_confidence"
    bl_label = "Show Confidence"
    bl_options = {"REGISTER", "UNDO"}

    action: EnumProperty(name="Action", description="Change of the tubes", items=ACTIONS)

    def execute(self, context):
        collection = loaded_scenes.active_collection(context)
        everyone = loaded_scenes.members(collection, "ANCHOR")
        selected = duplicate_delete.chosen(context) if context.selected_objects else []
        shown = [anchor for anchor in selected or everyone if confidence_tubes.helper_of(anchor) is not None]
        if self.action == "HIDE" or (self.action == "TOGGLE" and shown):
            count = sum(confidence_tubes.hide(anchor) for anchor in shown)
            self.report({"INFO"}, f"Removed {plural.of(count, 'tube')}")
            return {"FINISHED"}
        # Shadows follow their casters, so they get a tube only if selected.
        leaders = [a for a in everyone if physics.has_motion(a) and a.r5dgs_motion.leader is None]
        anchors = selected or leaders
        try:
            found = [(anchor, extrapolate.times_of(anchor)) for anchor in anchors]
            for anchor, times in found:
                if confidence_tubes.moves(anchor, times):
                    confidence_tubes.path(anchor, times)  # raises before any tube is created
            tubes = [confidence_tubes.show(anchor, times) for anchor, times in found]
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        count = sum(tube is not None for tube in tubes)
        if count == 0:
            self.report({"WARNING"}, "Nothing moves after the last observed time")
            return {"CANCELLED"}
        context.view_layer.update()
        self.report({"INFO"}, f"{plural.of(count, 'tube')} of 95 % confidence")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_show_confidence,)
