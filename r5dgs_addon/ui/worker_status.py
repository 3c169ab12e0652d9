"""Progress and result of *Test Worker*, drawn below its button in the preferences and the sidebar."""

from __future__ import annotations

from typing import Protocol

import bpy

from . import status_bar


class TestJob(Protocol):
    """Interface of `jobs.Job` used here. The module cannot import `jobs`, which depends on the preferences."""

    @property
    def doing(self) -> str:
        """Short description of the current step."""
        ...

    @property
    def done(self) -> bool:
        """True once it has ended."""
        ...

    @property
    def seconds(self) -> float:
        """Seconds since its start."""
        ...


_job: TestJob | None = None
_result: tuple[str, str] = ("", "NONE")  # text and icon


def begin(job: TestJob) -> None:
    """Show the progress of a test."""
    global _job, _result
    _job, _result = job, ("", "NONE")
    redraw()


def end(text: str, icon: str) -> None:
    """Show the result of a test."""
    global _job, _result
    _job, _result = None, (text, icon)
    redraw()


def redraw() -> None:
    """Redraw the areas that show the status."""
    status_bar.redraw("PREFERENCES", "VIEW_3D")


def draw(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the button, and the progress or result in lines that fit the region."""
    layout.operator("r5dgs.check_worker", icon="PLAY")
    text, icon = _result
    if _job is not None and not _job.done:
        text, icon = f"Testing: {_job.doing}, {_job.seconds:.0f} s; press Esc to stop", "SORTTIME"
    status_bar.wrapped(layout, context, text, icon)
