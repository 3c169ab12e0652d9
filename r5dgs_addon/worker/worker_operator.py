"""Operators that wait for the worker: beside the window where there is one, in place for scripts and `blender -b`."""

import bpy

from ...r5dgs_core import errors
from ..ui import status_bar, stepwise_operator
from . import jobs


class Waiting:
    """Mixed into an operator that begins a job and does something with its answer.

    The operator has ``_begin(context)``, which returns the job, ``_finish(context, answer)``, which returns what
    operators return, and ``waits_for``, what the status bar calls it.
    """

    waits_for = "R5DGS"

    def invoke(self, context, event):
        """Leave the window free; scripts and `blender -b` wait in `execute`."""
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
        """Look at the job when the timer says so; Esc gives it up."""
        if event.type == "ESC":
            self.cancel(context)
            self.report({"INFO"}, f"{self.waits_for} stopped; the next one starts the worker again")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if not self._job.done:
            status_bar.say(context, f"{self.waits_for}: {self._job.doing}, {self._job.seconds:.0f} s; Esc stops")
            return {"PASS_THROUGH"}
        self._leave(context)
        return self._answered(context)

    def cancel(self, context):
        """Give the job up."""
        self._job.cancel()
        self._leave(context)

    def execute(self, context):
        """Wait in place."""
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
        status_bar.say(context, None)
        status_bar.redraw()


def free(operator: type, key: str) -> bool:
    """Whether no job of a key runs, for an operator's ``poll``, which says otherwise why it is greyed out."""
    if jobs.busy(key):
        operator.poll_message_set("It is at work already; Esc stops it")
        return False
    return True
