"""Preview: rasterize what Blender shows into the image `R5DGS Preview`."""

import bpy

from ..r5dgs_addon import actions, figures, picture, waiting


class R5DGS_OT_preview(waiting.Waiting, actions.NeedsCamera, bpy.types.Operator):
    """Render the loaded scenes as the active camera sees them, in the worker, into the image 'R5DGS Preview'"""

    bl_idname = "r5dgs.preview"
    bl_label = "Preview"
    waits_for = "Preview"

    @classmethod
    def poll(cls, context):
        return waiting.free(cls, picture.PREVIEW) and super().poll(context)

    def _begin(self, context):
        return picture.start(context)

    def _finish(self, context, answer):
        image, _ = picture.finish(answer)
        place = [] if picture.show(context, image) else [f"open an Image Editor and choose '{image.name}' to see it"]
        self.report({"INFO"}, "; ".join([f"{image.name}: {figures.speed()}", *figures.errors(), *place]))
        return {"FINISHED"}


CLASSES = (R5DGS_OT_preview,)
