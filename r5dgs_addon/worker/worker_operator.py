"""Operators that wait for the worker: modal in the UI, blocking in scripts and background mode."""

import bpy

from ...r5dgs_core import errors
from ..ui import status_bar, stepwise_operator
from . import jobs


class WaitsForWorker:
    """Mixin for operators that submit a job and process its response.

    Subclasses define ``_begin(context)``, which returns the job; ``_finish(context, answer)``, which returns the
    operator's result; and ``waits_for``, the name shown in the status bar.
    """

    waits_for = "R5DGS"

    def invoke(self, context, event):
        """Start the job and run modal; without a window, run `execute`."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        try:
            self._job = self._begin(context)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self._timer = context.window_manager.event_timer_add(0.1, window=context.window)
        context.window_manager.modal_handler_add(self)
        stepwise_operator.begin(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        """Poll the job on each timer event; Esc cancels it."""
        if event.type == "ESC":
            self.cancel(context)
            self.report({"INFO"}, f"{self.waits_for} stopped; the next one starts the worker again")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if not self._job.done:
            status_bar.show(
                context, f"{self.waits_for}: {self._job.doing}, {self._job.seconds:.0f} s; press Esc to stop"
            )
            return {"PASS_THROUGH"}
        self._leave(context)
        return self._answered(context)

    def cancel(self, context):
        """Cancel the job."""
        self._job.cancel()
        self._leave(context)

    def execute(self, context):
        """Run the job and block until it ends."""
        try:
            self._job = self._begin(context)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return self._answered(context)

    def _answered(self, context):
        try:
            return self._finish(context, self._job.answer())
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}

    def _leave(self, context):
        stepwise_operator.end(self)
        context.window_manager.event_timer_remove(self._timer)
        status_bar.show(context, None)
        status_bar.redraw()


def is_free(operator: type, key: str) -> bool:
    """True if no job with this key runs; otherwise sets the poll message. For an operator's ``poll``."""
    if jobs.busy(key):
        operator.poll_message_set("Already running; press Esc to stop it")
        return False
    return True
