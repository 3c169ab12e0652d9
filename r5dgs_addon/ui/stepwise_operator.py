"""Operators that run step by step: beside the window with progress and Esc, at once for scripts and in `blender -b`."""

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

import bpy

from ...r5dgs_core import errors
from . import status_bar


@dataclass(frozen=True)
class Step:
    """Where long work stands.

    Attributes:
        done: Steps so far.
        total: Steps in all.
        what: What was just done, or is done next.
        slow: What is done next may take long, in one go; the window shows these words first.
    """

    done: int
    total: int
    what: str
    slow: bool = False


@dataclass(frozen=True)
class Outcome:
    """What long work has to say in the end.

    Attributes:
        text: What was done.
        warnings: What is not as one may expect.
    """

    text: str
    warnings: list[str] = field(default_factory=list)


BLINK_S = 0.2  # between two looks at the window, which is drawn anew then
Steps = Iterator[Step]  # a generator that returns an `Outcome`

_beside: list[bpy.types.Operator] = []  # what goes on beside the window


class Running:
    """Mixed into an operator that has ``steps``, and ``filepath`` or ``directory`` among its properties.

    The steps are closed where the user stops them, so that ``finally`` and ``with`` in them leave nothing half-done.
    """

    work = "Export"  # what the status bar calls it
    stopped = "files that were finished stay"  # what is said when it was stopped

    def steps(self, context: bpy.types.Context) -> Steps:
        """The work, a step at a time."""
        raise NotImplementedError

    def suggest(self, context: bpy.types.Context) -> bool:
        """Fill in a path where none is given. Returns whether to go on without asking for one."""
        return False

    def target_file(self, suffix: str) -> Path:
        """The file that ``filepath`` names, its suffix added where it is absent. ConfigError where it names none."""
        path = bpy.path.abspath(self.filepath)
        if not os.path.basename(path):
            raise errors.ConfigError(f"{self.work.lower()}: expected a {suffix} file, got '{path}'; give it a name")
        return Path(path if path.lower().endswith(suffix) else path + suffix)

    def target_folder(self) -> Path:
        """The folder that ``directory`` names. ConfigError where it names none."""
        if not self.directory:
            raise errors.ConfigError(f"{self.work.lower()}: expected a folder, got nothing; choose one")
        return Path(bpy.path.abspath(self.directory))

    def invoke(self, context, event):
        self._interactive = True
        if self.suggest(context):
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        try:
            self._steps = self.steps(context)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self._began, self._last = time.monotonic(), None
        if bpy.app.background or context.window is None or not getattr(self, "_interactive", False):
            while True:
                finished = self._step(context)
                if finished is not None:
                    return finished
        manager = context.window_manager
        manager.progress_begin(0, 1)
        manager.modal_handler_add(self)
        self._timer = manager.event_timer_add(0.01, window=context.window)
        begin(self)
        status_bar.say(context, f"{self.work}: begins; Esc stops")
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if event.type == "ESC":
            self.cancel(context)
            self.report({"INFO"}, f"{self.work} stopped; {self.stopped}")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}
        failed, finished, until = True, None, time.monotonic() + BLINK_S
        try:
            while finished is None and time.monotonic() < until:
                finished = self._step(context)
                if self._last is not None and self._last.slow:
                    break
            failed = False
        finally:  # the timer and the progress bar go, and the error is shown
            if failed or finished is not None:
                self._end(context)
        return finished or {"RUNNING_MODAL"}

    def cancel(self, context):
        """Blender ends the operator: the file browser is closed, or a window or the file while it runs."""
        if getattr(self, "_timer", None) is not None:
            try:
                self._steps.close()
            finally:  # where what the steps undo fails, too
                self._end(context)

    def _step(self, context):
        """Do one step; the operator's result when that was the last, else None."""
        try:
            step = next(self._steps)
        except StopIteration as end:
            self.report({"INFO"}, end.value.text)
            for warning in end.value.warnings:  # the last report is what the status bar shows
                self.report({"WARNING"}, warning)
            return {"FINISHED"}
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if step != self._last:
            self._last = step
            self._show(context, step)
        return None

    def _show(self, context, step: Step) -> None:
        left = (time.monotonic() - self._began) / max(step.done, 1) * (step.total - step.done)
        if bpy.app.background:
            values = {key: value for key, value in asdict(step).items() if key != "slow"}
            print(json.dumps({"event": self.work.lower(), **values, "seconds_left": left}), flush=True)
        elif getattr(self, "_timer", None) is not None:
            context.window_manager.progress_update(step.done / max(step.total, 1))
            rest = f", {left:.0f} s left" if step.done else ""
            stands = "" if step.slow else f", {step.done} of {step.total}{rest}; Esc stops"
            status_bar.say(context, f"{self.work}: {step.what}{stands}")

    def _end(self, context):
        end(self)
        context.window_manager.event_timer_remove(self._timer)
        self._timer = None
        context.window_manager.progress_end()
        status_bar.say(context, None)


def begin(operator: bpy.types.Operator) -> None:
    """Note that an operator goes on beside the window, for `stop_all`."""
    _beside.append(operator)


def end(operator: bpy.types.Operator) -> None:
    """Forget an operator that has ended."""
    _beside[:] = [other for other in _beside if other is not operator]


def stop_all(context: bpy.types.Context) -> None:
    """Stop what goes on beside the window, as Esc does. Blender itself does not where an operator's class goes."""
    for operator in list(_beside):
        operator.cancel(context)


@contextmanager
def cursor(context: bpy.types.Context) -> Iterator[Callable[[float], None]]:
    """Show at the mouse how far work is that the window has to wait for; gives what to call with the share done."""
    manager = context.window_manager
    if bpy.app.background or context.window is None:
        yield lambda share: None
        return
    manager.progress_begin(0, 100)
    try:
        yield lambda share: manager.progress_update(100 * share)
    finally:
        manager.progress_end()
