"""Live preview: while it is on, the image `R5DGS Preview` follows the frame and whatever else Blender shows.

A timer, in Blender's own thread, compares what the camera sees with what the image shows, and asks the worker for the
next picture where they differ and it is free: no handler, no data touched from a thread, and the latest state wins.
"""

from typing import Any

import bpy
from bpy.app.handlers import persistent

from ...r5dgs_core import errors
from ..ui import status_bar
from ..worker import jobs
from . import render_request

KEY = "live preview"  # what `jobs.busy` knows its pictures by
LOOK_S = 0.05  # between two looks while a picture is made
IDLE_S = 0.1  # between two looks at what Blender shows

_job: jobs.Job | None = None
_asked: list[tuple[str, str, dict[str, Any]]] | None = None  # what the last picture was asked for with
_message = ""


def running() -> bool:
    """Whether it is on."""
    return bpy.app.timers.is_registered(look)


def message() -> str:
    """Why there is no picture; else empty."""
    return _message


def start() -> None:
    """Switch it on."""
    global _asked, _message
    if not running():
        _asked, _message = None, ""
        bpy.app.timers.register(look, first_interval=0.0)


def stop() -> None:
    """Switch it off. A picture that is being made is not waited for."""
    global _job, _asked, _message
    _job, _asked, _message = None, None, ""
    if running():
        bpy.app.timers.unregister(look)


def look() -> float:
    """Take a picture that is ready, and ask for one of what Blender shows now. Returns seconds to the next look."""
    global _job, _asked, _message
    if _job is not None:
        if not _job.done:
            return LOOK_S
        job, _job = _job, None
        try:
            render_request.show(bpy.context, render_request.finish(job.answer())[0])
            _message = ""
        except errors.R5dgsError as error:
            _message = str(error)
        status_bar.redraw("VIEW_3D", "IMAGE_EDITOR")
    if jobs.busy() or bpy.app.is_job_running("RENDER"):
        return LOOK_S
    there = bpy.context.window_manager.windows
    if not there:
        return IDLE_S
    with bpy.context.temp_override(window=there[0]):
        try:
            steps = render_request.steps(render_request.shown(bpy.context.evaluated_depsgraph_get()))
            if steps == _asked:
                return IDLE_S
            _asked, _job = steps, jobs.submit(KEY, steps)
        except errors.R5dgsError as error:
            if str(error) != _message:
                _message = str(error)
                status_bar.redraw("VIEW_3D", "IMAGE_EDITOR")
            return IDLE_S
    return LOOK_S


@persistent
def _stop_before_load(*_):
    """Another file is about to be opened: nothing of this one may be touched any more."""
    stop()


def register():
    """Listen to loading."""
    bpy.app.handlers.load_pre.append(_stop_before_load)


def unregister():
    """Switch it off, and undo `register`."""
    stop()
    if _stop_before_load in bpy.app.handlers.load_pre:
        bpy.app.handlers.load_pre.remove(_stop_before_load)
