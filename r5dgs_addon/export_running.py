"""Exports run step by step: beside the window with progress and Esc, at once for scripts and in `blender -b`."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import bpy

from ..r5dgs_core import errors


@dataclass(frozen=True)
class Step:
    """One step of an export that is over.

    Attributes:
        done: Steps so far.
        total: Steps in all.
        what: What is being written.
    """

    done: int
    total: int
    what: str


@dataclass(frozen=True)
class Outcome:
    """What an export has to say in the end.

    Attributes:
        text: What was written.
        warnings: What is not as one may expect.
    """

    text: str
    warnings: list[str] = field(default_factory=list)


FRAMES = (
    ("CURRENT", "This Frame", "The frame that is shown"),
    ("RANGE", "Frame Range", "Every frame of the scene's range, numbered"),
)
BLINK_S = 0.2  # between two looks at the window, which is drawn anew then
Steps = Iterator[Step]  # a generator that returns an `Outcome`


class Exporter:
    """An operator that exports: give it `steps`, and `filepath` or `directory` among its properties.

    Files are complete or absent at any moment, so that stopping leaves what was finished and nothing else.
    """

    def steps(self, context: bpy.types.Context) -> Steps:
        """The work, a step at a time."""
        raise NotImplementedError

    def invoke(self, context, event):
        self._interactive = True
        if self.suggest(context):
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def suggest(self, context) -> bool:
        """Fill in a path where none is given. Returns whether to go on without asking for one."""
        return False

    def execute(self, context):
        try:
            self._running = self.steps(context)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if bpy.app.background or context.window is None or not getattr(self, "_interactive", False):
            while True:
                finished = self._step(context)
                if finished is not None:
                    return finished
        manager = context.window_manager
        manager.progress_begin(0, 1)
        manager.modal_handler_add(self)
        self._timer = manager.event_timer_add(0.01, window=context.window)
        return {"RUNNING_MODAL"}

    def cancel(self, context):
        """Blender ends the operator: the file browser is closed, or a window or the file while it runs."""
        if getattr(self, "_timer", None) is not None:
            self._running.close()
            self._end(context)

    def modal(self, context, event):
        if event.type == "ESC":
            self.cancel(context)
            self.report({"INFO"}, "Export stopped; files that were finished stay")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}
        failed, finished, until = True, None, time.monotonic() + BLINK_S
        try:
            while finished is None and time.monotonic() < until:
                finished = self._step(context)
            failed = False
        finally:  # the timer and the progress bar go, and the error is shown
            if failed or finished is not None:
                self._end(context)
        return finished or {"RUNNING_MODAL"}

    def _step(self, context):
        """Do one step; the operator's result when that was the last, else None."""
        try:
            step = next(self._running)
        except StopIteration as end:
            self.report({"INFO"}, end.value.text)
            for warning in end.value.warnings:  # the last report is what the status bar shows
                self.report({"WARNING"}, warning)
            return {"FINISHED"}
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if getattr(self, "_timer", None) is not None:
            context.window_manager.progress_update(step.done / max(step.total, 1))
            if context.workspace is not None:
                context.workspace.status_text_set(f"Export: {step.what}, {step.done} of {step.total}; Esc stops")
        return None

    def _end(self, context):
        context.window_manager.event_timer_remove(self._timer)
        self._timer = None
        context.window_manager.progress_end()
        if context.workspace is not None:
            context.workspace.status_text_set(None)


def draw_properties(operator, *names: str) -> None:
    """Draw properties of an export; the frame step where there is a range alone."""
    layout = operator.layout
    layout.use_property_split = True
    layout.use_property_decorate = False
    for name in names:
        if name != "frame_step" or operator.frames == "RANGE":
            layout.prop(operator, name)


@contextmanager
def frame_kept(scene: bpy.types.Scene) -> Iterator[None]:
    """Bring a Blender scene back to the frame where it was, sub-frame included."""
    frame, subframe = scene.frame_current, scene.frame_subframe
    try:
        yield
    finally:
        if (scene.frame_current, scene.frame_subframe) != (frame, subframe):
            scene.frame_set(frame, subframe=subframe)


def frames_of(scene: bpy.types.Scene, every: bool, step: int = 1) -> list[int]:
    """The frames of a Blender scene's range, or the current one alone."""
    return list(range(scene.frame_start, scene.frame_end + 1, max(step, 1))) if every else [scene.frame_current]


def go_to(scene: bpy.types.Scene, frame: int) -> None:
    """Show a whole frame; the current one keeps its sub-frame, and edits that no key holds."""
    if frame != scene.frame_current:
        scene.frame_set(frame)


def numbered(path, frame: int):
    """The path of one frame of a sequence: scene.ply -> scene_0012.ply."""
    return path.with_name(f"{path.stem}_{frame:04d}{path.suffix}")
