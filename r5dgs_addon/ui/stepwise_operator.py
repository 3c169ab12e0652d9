"""Operators that run step by step: modal with progress and Esc in the UI, blocking in scripts and background mode."""

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
    """Progress of a long operation.

    Attributes:
        done: Number of completed steps.
        total: Total number of steps.
        what: Description of the step that was just completed or comes next.
        slow: True if the next step may block for long; the window then shows ``what`` first.
    """

    done: int
    total: int
    what: str
    slow: bool = False


@dataclass(frozen=True)
class Outcome:
    """Result of a long operation.

    Attributes:
        text: Summary for the user.
        warnings: Warnings for the user.
    """

    text: str
    warnings: list[str] = field(default_factory=list)


BLINK_S = 0.2  # time between redraws of the window (s)
Steps = Iterator[Step]  # a generator that returns an `Outcome`

_running_operators: list[bpy.types.Operator] = []  # operators that currently run modal


class Stepwise:
    """Mixin for operators with ``steps`` and a ``filepath`` or ``directory`` property.

    If the user stops the operator, the generator is closed, so that its ``finally`` and ``with`` blocks can clean up.
    """

    work = "Export"  # name of the operation in the status bar
    stopped = "files that were finished stay"  # appended to the report if the user stops the operation

    def steps(self, context: bpy.types.Context) -> Steps:
        """Return a generator that performs the operation one step at a time."""
        raise NotImplementedError

    def suggest(self, context: bpy.types.Context) -> bool:
        """Set a default path. Returns True to run without opening the file browser."""
        return False

    def suggest_file(self, stem: str, suffix: str) -> None:
        """Set ``filepath`` unless it is set: in the folder of the .blend and named after it, else named ``stem``."""
        if not self.filepath and bpy.data.filepath:
            self.filepath = str(Path(bpy.data.filepath).with_suffix(suffix))
        elif not self.filepath:
            self.filepath = f"{stem}{suffix}"

    def target_file(self, suffix: str) -> Path:
        """Return the file of ``filepath`` with the suffix added if missing. Raises ConfigError if it names no file."""
        path = bpy.path.abspath(self.filepath)
        if not os.path.basename(path):
            raise errors.ConfigError(f"{self.work.lower()}: expected a {suffix} file, got '{path}'; give it a name")
        return Path(path if path.lower().endswith(suffix) else path + suffix)

    def target_folder(self) -> Path:
        """Return the folder of ``directory``. Raises ConfigError if it is empty."""
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
        status_bar.show(context, f"{self.work}: starting; press Esc to stop")
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
        finally:  # remove the timer and progress bar after an error, too
            if failed or finished is not None:
                self._end(context)
        return finished or {"RUNNING_MODAL"}

    def cancel(self, context):
        """Called by Blender if the file browser is closed, or if a window or the file closes during the operation."""
        if getattr(self, "_timer", None) is not None:
            try:
                self._steps.close()
            finally:  # even if the cleanup of the steps fails
                self._end(context)

    def _step(self, context):
        """Run one step. Returns the operator's result after the last step, otherwise None."""
        try:
            step = next(self._steps)
        except StopIteration as end:
            self.report({"INFO"}, end.value.text)
            for warning in end.value.warnings:  # reported last, because the status bar shows the last report
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
            stands = "" if step.slow else f", {step.done} of {step.total}{rest}; press Esc to stop"
            status_bar.show(context, f"{self.work}: {step.what}{stands}")

    def _end(self, context):
        end(self)
        context.window_manager.event_timer_remove(self._timer)
        self._timer = None
        context.window_manager.progress_end()
        status_bar.show(context, None)


def begin(operator: bpy.types.Operator) -> None:
    """Register a running modal operator for `stop_all`."""
    _running_operators.append(operator)


def end(operator: bpy.types.Operator) -> None:
    """Remove an operator that has ended."""
    _running_operators[:] = [other for other in _running_operators if other is not operator]


def stop_all(context: bpy.types.Context) -> None:
    """Cancel all running modal operators, because Blender does not do so when their classes are unregistered."""
    for operator in list(_running_operators):
        operator.cancel(context)


@contextmanager
def cursor(context: bpy.types.Context) -> Iterator[Callable[[float], None]]:
    """Show blocking progress at the mouse cursor. Yields a callback that takes the completed fraction."""
    manager = context.window_manager
    if bpy.app.background or context.window is None:
        yield lambda share: None
        return
    manager.progress_begin(0, 100)
    try:
        yield lambda share: manager.progress_update(100 * share)
    finally:
        manager.progress_end()
