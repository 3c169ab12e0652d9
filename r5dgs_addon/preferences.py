"""The add-on's preferences: which Python runs the worker."""

import os
import sys
import threading
from pathlib import Path

import bpy
from bpy.props import IntProperty, StringProperty

from .. import __package__ as base_package
from . import pythons

ENVIRONMENT = "R5DGS_PYTHON"
ROOT = Path(__file__).resolve().parent.parent

_found: str | None = None  # what the search found in this session, "" for nothing; None before it


class R5DGS_AP_preferences(bpy.types.AddonPreferences):
    """Preferences under Edit > Preferences > Add-ons > R5DGS."""

    bl_idname = base_package

    worker_python: StringProperty(
        name="Worker Python",
        description="Python with torch and numba that renders pictures; searched for in the usual places where empty",
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
    found_python: StringProperty(
        name="Found Python", description="What the search for a Python found last", options={"HIDDEN"}
    )

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "worker_python")
        if os.environ.get(ENVIRONMENT):
            layout.label(text=f"{ENVIRONMENT} is set and wins: {os.environ[ENVIRONMENT]}", icon="INFO")
        elif not self.worker_python and self.found_python:
            layout.label(text=f"Found: {self.found_python}", icon="INFO")
        layout.prop(self, "worker_timeout")
        layout.operator("r5dgs.check_worker", icon="PLAY")


def get() -> "R5DGS_AP_preferences | None":
    """The preferences, or None where the add-on was registered without being enabled as an extension."""
    addon = bpy.context.preferences.addons.get(base_package)
    return addon.preferences if addon else None


def worker_python() -> str:
    """Python to start the worker with: the environment's, the preferences', or the first one found that will do.

    The search takes a moment; what it finds is remembered. Where nothing will do, Blender's own is named: the worker
    says what it lacks.
    """
    chosen = os.environ.get(ENVIRONMENT, "").strip()
    preferences = get()
    if not chosen and preferences is not None:
        chosen = preferences.worker_python.strip()
    if chosen:
        return str(Path(bpy.path.abspath(chosen)).expanduser())
    known = _found
    if known is None and preferences is not None:
        known = preferences.found_python or None
    if known is None or (known and not Path(known).is_file()):
        known = search()
    return known or sys.executable


def search() -> str:
    """Look for a Python that can run the worker and remember it, in the preferences, too, where that is allowed.

    Returns:
        Its path; "" where there is none.
    """
    global _found
    _found = pythons.find(_beside()) or ""
    if threading.current_thread() is not threading.main_thread():  # a render: it must not write Blender's data
        return _found
    preferences = get()
    if preferences is not None and preferences.found_python != _found:
        preferences.found_python = _found
    return _found


def forget() -> None:
    """Have the next `worker_python` search again."""
    global _found
    _found = None
    preferences = get()
    if preferences is not None and preferences.found_python:
        preferences.found_python = ""


def worker_timeout_s() -> float:
    """Seconds to wait for an answer of the worker."""
    preferences = get()
    return float(preferences.worker_timeout) if preferences is not None else 120.0


def _beside() -> list[Path]:
    """Folders that are the extension's own: its code's, and what Blender gives it for files of the user."""
    try:
        own = [Path(bpy.utils.extension_path_user(base_package))]
    except ValueError:  # not enabled as an extension
        own = []
    return [*own, ROOT]


def register():
    """Register the preferences' class."""
    bpy.utils.register_class(R5DGS_AP_preferences)


def unregister():
    """Undo `register`."""
    bpy.utils.unregister_class(R5DGS_AP_preferences)
