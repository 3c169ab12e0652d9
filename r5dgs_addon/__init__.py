"""Services of the add-on: objects, keyframes, properties, preferences, panels and the worker's client."""

from . import (
    click,
    cloud_points,
    engine,
    figures,
    handlers,
    live_preview,
    look,
    motion_exact,
    motion_extrapolate,
    motion_physics,
    motion_pivot,
    panels,
    preferences,
    properties,
    render_notes,
    table,
    words,
    worker,
)

MODULES = (
    properties,
    look,
    table,
    words,
    motion_physics,
    motion_extrapolate,
    motion_pivot,
    motion_exact,
    cloud_points,
    preferences,
    figures,
    render_notes,
    engine,
    panels,
    handlers,
    click,
    worker,
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
