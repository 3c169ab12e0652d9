"""Show Captured Images operator: images of the data set as backgrounds of the captured cameras."""

import bpy
from bpy.props import BoolProperty, StringProperty

from ..r5dgs_addon.scene import captured_images, loaded_scenes, polls
from ..r5dgs_addon.ui import plural
from ..r5dgs_core import errors


class R5DGS_OT_show_captured_images(polls.NeedsCapturedCameras, bpy.types.Operator):
    """Show the data set's images of the current time in views through the captured cameras"""

    bl_idname = "r5dgs.show_captured_images"
    bl_label = "Show Captured Images"
    bl_options = {"REGISTER", "UNDO"}

    directory: StringProperty(
        name="Folder", description="Folder of the data set that the scene was trained on", subtype="DIR_PATH"
    )
    filter_folder: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        collection = loaded_scenes.active_collection(context)
        try:
            count = captured_images.show(collection, self.directory, context.scene.frame_current_final)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Images in {plural.of(count, 'camera')}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_show_captured_images,)
