"""Services of the add-on: objects, keyframes, properties, preferences, panels and the worker's client."""

from . import engine, handlers, look, motion_exact, motion_physics, panels, preferences, properties, worker

MODULES = (properties, look, motion_physics, motion_exact, preferences, engine, panels, handlers, worker)


def register():
    """Register every module."""
    for module in MODULES:
        module.register()


def unregister():
    """Undo `register` in reverse order."""
    for module in reversed(MODULES):
        module.unregister()
