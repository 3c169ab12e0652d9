"""Live preview: keeps the image `R5DGS Preview` up to date with the current frame and scene.

A timer in Blender's main thread compares the camera's view with the image. If they differ and the worker is idle, it
requests the next image. No handlers are needed, no thread touches Blender's data, and the latest state wins.
"""

from typing import Any

import bpy
from bpy.app.handlers import persistent

from ...r5dgs_core import errors
from ..ui import status_bar
from ..worker import jobs
from . import render_request

KEY = "live preview"  # job key for `jobs.busy`
POLL_S = 0.05  # timer interval while an image is rendered
IDLE_S = 0.1  # timer interval while the image is up to date

_job: jobs.Job | None = None
_last_steps: list[tuple[str, str, dict[str, Any]]] | None = None  # steps of the last request
_message = ""


def running() -> bool:
    """True if the live preview is on."""
    return bpy.app.timers.is_registered(poll)


def message() -> str:
    """Error of the last preview image, or ""."""
    return _message


def start() -> None:
    """Start the live preview."""
    global _last_steps, _message
    if not running():
        _last_steps, _message = None, ""
        bpy.app.timers.register(poll, first_interval=0.0)


def stop() -> None:
    """Stop the live preview without waiting for a running render."""
    global _job, _last_steps, _message
    _job, _last_steps, _message = None, None, ""
    if running():
        bpy.app.timers.unregister(poll)


def poll() -> float:
    """Show a finished image and request the next one if the view changed. Returns the timer interval in seconds."""
    global _job, _last_steps, _message
    if _job is not None:
        if not _job.done:
            return POLL_S
        job, _job = _job, None
        try:
            render_request.show(bpy.context, render_request.finish(job.answer())[0])
            _message = ""
        except errors.R5dgsError as error:
            _message = str(error)
        status_bar.redraw("VIEW_3D", "IMAGE_EDITOR")
    if jobs.busy() or bpy.app.is_job_running("RENDER"):
        return POLL_S
    windows = bpy.context.window_manager.windows
    if not windows:
        return IDLE_S
    with bpy.context.temp_override(window=windows[0]):
        try:
            steps = render_request.steps(render_request.shown(bpy.context.evaluated_depsgraph_get()))
            if steps == _last_steps:
                return IDLE_S
            _last_steps, _job = steps, jobs.submit(KEY, steps)
        except errors.R5dgsError as error:
            if str(error) != _message:
                _message = str(error)
                status_bar.redraw("VIEW_3D", "IMAGE_EDITOR")
            return IDLE_S
    return POLL_S


@persistent
def _stop_before_load(*_):
    """Stop before another file is opened, because data of this one must not be accessed afterwards."""
    stop()


def register():
    """Register the load handler."""
    bpy.app.handlers.load_pre.append(_stop_before_load)


def unregister():
    """Stop the live preview and undo `register`."""
    stop()
    if _stop_before_load in bpy.app.handlers.load_pre:
        bpy.app.handlers.load_pre.remove(_stop_before_load)
