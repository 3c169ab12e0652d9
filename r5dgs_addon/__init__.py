"""Services of the extension: objects, keyframes, properties, preferences, panels and the worker client."""

from . import panels, preferences
from .clean_up import criteria, overlay
from .engine import engine, live_preview, mesh_merge, render_command, render_notes, render_stats
from .language import prompt_state
from .motion import contact_fields, event_markers, exact_mode, extrapolate, motion_fields, pivot
from .scene import (
    captured_images,
    click_select,
    evaluated_points,
    hidden_points,
    object_names,
    object_tint,
    properties,
    relink,
)
from .splats import viewport_splats
from .ui import manual
from .worker import jobs

MODULES = (
    properties,
    object_tint,
    object_names,
    hidden_points,
    captured_images,
    prompt_state,
    motion_fields,
    contact_fields,
    extrapolate,
    pivot,
    exact_mode,
    event_markers,
    evaluated_points,
    preferences,
    render_stats,
    render_notes,
    mesh_merge,
    engine,
    render_command,
    viewport_splats,
    criteria,
    overlay,
    panels,
    manual,
    relink,
    click_select,
    jobs,
    live_preview,
)


def register():
    """Register every module."""
    for module in MODULES:
        module.register()


def unregister():
    """Undo `register` in reverse order."""
    for module in reversed(MODULES):
        module.unregister()
