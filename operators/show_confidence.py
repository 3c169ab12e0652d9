"""Show Confidence: how sure the extrapolated paths are, as tubes in the viewport."""

import bpy
from bpy.props import EnumProperty

from ..r5dgs_addon.motion import confidence_tubes, duplicate_delete, extrapolate, physics
from ..r5dgs_addon.scene import loaded_scenes, polls
from ..r5dgs_addon.ui import plural
from ..r5dgs_core import errors

ACTIONS = (
    ("TOGGLE", "Toggle", "Remove the tubes where there are some, else make them"),
    ("SHOW", "Show", "Make or renew the tubes"),
    ("HIDE", "Hide", "Remove the tubes"),
)


class R5DGS_OT_show_confidence(polls.NeedsScene, bpy.types.Operator):
    """Show the paths of the selected objects, or of all, as tubes as thick as one standard deviation"""

    bl_idname = "r5dgs.show_confidence"
    bl_label = "Show Confidence"
    bl_options = {"REGISTER", "UNDO"}

    action: EnumProperty(name="Action", description="What to do", items=ACTIONS)

    def execute(self, context):
        collection = loaded_scenes.active_collection(context)
        everyone = loaded_scenes.members(collection, "ANCHOR")
        selected = duplicate_delete.chosen(context) if context.selected_objects else []
        shown = [anchor for anchor in selected or everyone if confidence_tubes.helper_of(anchor) is not None]
        if self.action == "HIDE" or (self.action == "TOGGLE" and shown):
            count = sum(confidence_tubes.hide(anchor) for anchor in shown)
            self.report({"INFO"}, f"Removed {plural.of(count, 'tube')}")
            return {"FINISHED"}
        # Shadows go where their casters go: a tube of their own is shown to who asks for it.
        leaders = [a for a in everyone if physics.has_motion(a) and a.r5dgs_motion.leader is None]
        anchors = selected or leaders
        try:
            found = [(anchor, extrapolate.times_of(anchor)) for anchor in anchors]
            for anchor, times in found:
                if confidence_tubes.moves(anchor, times):
                    confidence_tubes.path(anchor, times)  # what is refused is refused before there is any tube
            tubes = [confidence_tubes.show(anchor, times) for anchor, times in found]
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        count = sum(tube is not None for tube in tubes)
        if count == 0:
            self.report({"WARNING"}, "Nothing moves after the last observed time")
            return {"CANCELLED"}
        context.view_layer.update()
        self.report({"INFO"}, f"{plural.of(count, 'tube')}, as thick as one standard deviation")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_show_confidence,)
