"""Preview: rasterize what Blender shows into the image `R5DGS Preview`."""

import bpy

from ..r5dgs_addon import objects, picture, worker
from ..r5dgs_core import errors


class R5DGS_OT_preview(bpy.types.Operator):
    """Render the loaded scenes as the active camera sees them, in the worker, into the image 'R5DGS Preview'"""

    bl_idname = "r5dgs.preview"
    bl_label = "Preview"

    @classmethod
    def poll(cls, context):
        if worker.busy(picture.PREVIEW):
            cls.poll_message_set("A preview is being rendered; Esc stops it")
            return False
        if objects.active_collection(context) is None:
            cls.poll_message_set("Load an R5DGS scene first")
            return False
        if context.scene.camera is None:
            cls.poll_message_set("Add a camera to the scene first")
            return False
        return True

    def invoke(self, context, event):
        """Render beside the window, which stays free; scripts and `blender -b` wait in `execute`."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        try:
            self._job = picture.start(context)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self._timer = context.window_manager.event_timer_add(0.1, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if event.type == "ESC":
            self.cancel(context)
            self.report({"INFO"}, "Preview stopped; the next one starts the worker again")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if not self._job.done:
            _say(context, f"Preview: {self._job.doing}, {self._job.seconds:.0f} s; Esc stops")
            return {"PASS_THROUGH"}
        self._leave(context)
        try:
            image, result = picture.finish(self._job.answer())
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return self._done(context, image, result)

    def cancel(self, context):
        """Leave the picture unfinished."""
        self._job.cancel()
        self._leave(context)

    def execute(self, context):
        try:
            image, result = picture.preview(context)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return self._done(context, image, result)

    def _done(self, context, image, result):
        milliseconds = result["ms_motion"] + result["ms_raster"]
        session = context.window_manager.r5dgs
        session.preview_ms = milliseconds
        session.preview_size = f"{image.size[0]} x {image.size[1]}"
        self.report({"INFO"}, f"{image.name}: {session.preview_size} in {milliseconds:.0f} ms")
        return {"FINISHED"}

    def _leave(self, context):
        context.window_manager.event_timer_remove(self._timer)
        _say(context, None)
        for window in context.window_manager.windows:
            for area in window.screen.areas:
                area.tag_redraw()


def _say(context, text):
    if context.workspace is not None:
        context.workspace.status_text_set(text)


CLASSES = (R5DGS_OT_preview,)
