"""Allow operator: trust the scene file of a .blend, which is outside the folder of the .blend."""

import bpy
from bpy.props import BoolProperty

from ..r5dgs_addon import preferences
from ..r5dgs_addon.motion import exact_mode
from ..r5dgs_addon.scene import loaded_scenes, polls, trust
from ..r5dgs_addon.ui import status_bar


class R5DGS_OT_allow_scene_file(polls.NeedsScene, bpy.types.Operator):
    """Allow the .blend to read its scene file, which is outside the folder of the .blend"""

    bl_idname = "r5dgs.allow_scene_file"
    bl_label = "Allow"

    always: BoolProperty(
        name="Always",
        description="Add the file's folder to the trusted folders of the preferences",
        options={"SKIP_SAVE"},
    )

    def execute(self, context):
        found = trust.find(loaded_scenes.active_collection(context))
        if found.asked is None:
            self.report({"WARNING"}, "There is no file to allow")
            return {"CANCELLED"}
        trust.allow(found.asked)
        if self.always:
            preferences.trust(str(found.asked.parent))
        exact_mode.refresh()
        status_bar.redraw()
        self.report({"INFO"}, f"{found.asked}: reading allowed")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_allow_scene_file,)
