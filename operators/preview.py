"""Preview: rasterize what Blender shows into the image `R5DGS Preview`."""

import bpy

from ..r5dgs_addon import objects, picture
from ..r5dgs_core import errors


class R5DGS_OT_preview(bpy.types.Operator):
    """Render the loaded scene as the active camera sees it, in the worker, into the image 'R5DGS Preview'"""

    bl_idname = "r5dgs.preview"
    bl_label = "Preview"

    @classmethod
    def poll(cls, context):
        if objects.active_collection(context) is None:
            cls.poll_message_set("Load an R5DGS scene first")
            return False
        if context.scene.camera is None:
            cls.poll_message_set("Add a camera to the scene first")
            return False
        return True

    def execute(self, context):
        try:
            image, milliseconds = picture.preview(context, objects.active_collection(context))
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        session = context.window_manager.r5dgs
        session.preview_ms = milliseconds
        session.preview_size = f"{image.size[0]} x {image.size[1]}"
        self.report({"INFO"}, f"{image.name}: {session.preview_size} in {milliseconds:.0f} ms")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_preview,)
