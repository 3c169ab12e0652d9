"""The add-on's preferences: which Python runs the worker."""

import os
import sys
from pathlib import Path

import bpy
from bpy.props import IntProperty, StringProperty

from .. import __package__ as base_package

ENVIRONMENT = "R5DGS_PYTHON"


class R5DGS_AP_preferences(bpy.types.AddonPreferences):
    """Preferences under Edit > Preferences > Add-ons > R5DGS."""

    bl_idname = base_package

    worker_python: StringProperty(
        name="Worker Python",
        description="Python with torch and numba that renders previews; Blender's own where this is empty",
        subtype="FILE_PATH",
    )
    worker_timeout: IntProperty(
        name="Timeout",
        description="Seconds to wait for the worker; the first picture compiles the rasterizer, which takes a while",
        default=120,
        min=1,
        max=3600,
        subtype="TIME_ABSOLUTE",
    )

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "worker_python")
        if os.environ.get(ENVIRONMENT):
            layout.label(text=f"{ENVIRONMENT} is set and wins: {os.environ[ENVIRONMENT]}", icon="INFO")
        layout.prop(self, "worker_timeout")
        layout.operator("r5dgs.check_worker", icon="PLAY")


def get() -> "R5DGS_AP_preferences | None":
    """The preferences, or None where the add-on was registered without being enabled as an extension."""
    addon = bpy.context.preferences.addons.get(base_package)
    return addon.preferences if addon else None


def worker_python() -> str:
    """Python to start the worker with: the environment's, the preferences', or Blender's own."""
    chosen = os.environ.get(ENVIRONMENT, "").strip()
    preferences = get()
    if not chosen and preferences is not None:
        chosen = preferences.worker_python.strip()
    if chosen:
        return str(Path(bpy.path.abspath(chosen)).expanduser())
    return sys.executable


def worker_timeout_s() -> float:
    """Seconds to wait for an answer of the worker."""
    preferences = get()
    return float(preferences.worker_timeout) if preferences is not None else 120.0


def register():
    """Register the preferences' class."""
    bpy.utils.register_class(R5DGS_AP_preferences)


def unregister():
    """Undo `register`."""
    bpy.utils.unregister_class(R5DGS_AP_preferences)
