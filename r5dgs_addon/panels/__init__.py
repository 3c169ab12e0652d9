"""Panels of the *R5DGS* sidebar tab. Each module lists its panels in ``CLASSES``, in sidebar order."""

import bpy

from . import capture, clean_up, contact, export, motion, objects, observed_motion, preview, prompt, render, scene

MODULES = (scene, objects, prompt, motion, contact, observed_motion, clean_up, preview, export, capture, render)


def register():
    """Register the panels."""
    for module in MODULES:
        for cls in module.CLASSES:
            bpy.utils.register_class(cls)


def unregister():
    """Undo `register`."""
    for module in reversed(MODULES):
        for cls in reversed(module.CLASSES):
            bpy.utils.unregister_class(cls)
