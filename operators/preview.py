"""Preview operator: render the scene in the worker into the image `R5DGS Preview`."""

import bpy

from ..r5dgs_addon.engine import render_request, render_stats
from ..r5dgs_addon.scene import polls
from ..r5dgs_addon.worker import worker_operator


class R5DGS_OT_preview(worker_operator.WaitsForWorker, polls.NeedsCamera, bpy.types.Operator):
    """Render the loaded scenes through the active camera into the image 'R5DGS Preview'"""

    bl_idname = "r5dgs.preview"
    bl_label = "Preview"
    waits_for = "Preview"

    @classmethod
    def poll(cls, context):
        return worker_operator.is_free(cls, render_request.PREVIEW) and super().poll(context)

    def _begin(self, context):
        return render_request.start(context)

    def _finish(self, context, answer):
        image, _ = render_request.finish(answer)
        place = (
            [] if render_request.show(context, image) else [f"open an Image Editor and choose '{image.name}' to see it"]
        )
        self.report({"INFO"}, "; ".join([f"{image.name}: {render_stats.speed()}", *render_stats.errors(), *place]))
        return {"FINISHED"}


CLASSES = (R5DGS_OT_preview,)
