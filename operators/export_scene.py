"""Save Edited Scene operator: a loaded scene with its edits as a new .r5dgs file."""

import bpy
from bpy.props import BoolProperty, StringProperty

from ..r5dgs_addon.engine import render_request
from ..r5dgs_addon.export import scene
from ..r5dgs_addon.scene import loaded_scenes, polls
from ..r5dgs_addon.ui import stepwise_operator
from ..r5dgs_core import errors


class R5DGS_OT_export_scene(polls.NeedsScene, stepwise_operator.Stepwise, bpy.types.Operator):
    """Save the active scene with its edits as a .r5dgs file: names, colors, deleted and moved objects, motion"""

    bl_idname = "r5dgs.export_scene"
    bl_label = "Save Edited Scene"
    bl_options = {"REGISTER", "PRESET"}

    filepath: StringProperty(name="File", description="New .r5dgs file", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default="*.r5dgs", options={"HIDDEN"})
    check_existing: BoolProperty(default=True, options={"HIDDEN"})
    exact: BoolProperty(
        name="Full Precision",
        description="Store all numbers in full precision; the file is about twice as large",
        default=False,
    )

    def suggest(self, context):
        if not self.filepath:
            try:
                source = render_request.scene_path(loaded_scenes.active_collection(context))
                self.filepath = str(source.with_name(f"{source.stem}_edited.r5dgs"))
            except errors.R5dgsError:
                self.filepath = "edited.r5dgs"
        return False

    def steps(self, context):
        target = self.target_file(".r5dgs")
        return scene.steps(context, loaded_scenes.active_collection(context), target, exact=self.exact)


CLASSES = (R5DGS_OT_export_scene,)
