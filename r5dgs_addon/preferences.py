"""Preferences of the extension: worker Python, timeout, text encoder and trusted folders.

Preferences are read and written only in Blender's main thread. Other threads use a `Snapshot` created there. The search
for a Python does not touch Blender's data, so it can run in any thread.
"""

import functools
import logging
import os
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import bpy
from bpy.props import IntProperty, StringProperty

from .. import __package__ as base_package
from ..r5dgs_core import errors, user_settings
from . import find_python
from .ui import status_bar, worker_status

ENVIRONMENT = "R5DGS_PYTHON"
ENCODER_ENVIRONMENT = "R5DGS_TEXT_ENCODER"
TRUSTED_ENVIRONMENT = "R5DGS_TRUSTED_FOLDERS"
INSTALLED = "text"  # value of "Text Encoder" that selects the installed package with a small text encoder
ROOT = Path(__file__).resolve().parent.parent

log = logging.getLogger(__name__)
_found: str | None = None  # result of this session's search, "" if nothing was found, None before the search
_last: "Snapshot | None" = None  # last snapshot of the preferences


def _remember(_: bpy.types.AddonPreferences, context: bpy.types.Context) -> None:
    snapshot()


class R5DGS_AP_preferences(bpy.types.AddonPreferences):
    """Preferences under Edit > Preferences > Add-ons > R5DGS."""

    bl_idname = base_package

    worker_python: StringProperty(
        name="Worker Python",
        description="Python with numba that runs the worker, and with torch for text encoders; if empty, the one of "
        "'r5dgs config --user' or the first suitable one in the usual places, Blender's own included",
        subtype="FILE_PATH",
        update=_remember,
    )
    worker_timeout: IntProperty(
        name="Timeout",
        description="Seconds to wait for the worker to start and to respond; the first render compiles the "
        "rasterizer, which takes longer",
        default=120,
        min=1,
        max=3600,
        subtype="TIME_ABSOLUTE",
        update=_remember,
    )
    text_encoder: StringProperty(
        name="Text Encoder",
        description="Folder of the encoder that made the scenes' lookup tables, for words that the tables do not hold; "
        "'text' for the installed package",
        subtype="DIR_PATH",
    )
    trusted_folders: StringProperty(
        name="Trusted Folders",
        description=f"Folders from which any .blend may load scene files, separated by '{os.pathsep}'; files "
        "next to a .blend or below it need no entry",
        update=_remember,
    )
    found_python: StringProperty(
        name="Found Python", description="Result of the last search for a Python", options={"HIDDEN"}
    )

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "worker_python")
        if os.environ.get(ENVIRONMENT):
            layout.label(text=f"Overridden by {ENVIRONMENT}: {os.environ[ENVIRONMENT]}", icon="INFO")
        elif not self.worker_python and (named := _of_user_settings()):
            layout.label(text=f"From 'r5dgs config --user': {named}", icon="INFO")
        elif not self.worker_python:
            text, icon = _search_result(self.found_python)
            status_bar.wrapped(layout, context, text, icon)
        layout.prop(self, "worker_timeout")
        layout.prop(self, "text_encoder")
        if os.environ.get(ENCODER_ENVIRONMENT):
            text = f"Overridden by {ENCODER_ENVIRONMENT}: {os.environ[ENCODER_ENVIRONMENT]}"
            layout.label(text=text, icon="INFO")
        layout.prop(self, "trusted_folders")
        if os.environ.get(TRUSTED_ENVIRONMENT):
            layout.label(text=f"Also {TRUSTED_ENVIRONMENT}: {os.environ[TRUSTED_ENVIRONMENT]}", icon="INFO")
        worker_status.draw(layout, context)


def _search_result(found: str) -> tuple[str, str]:
    """Text and icon about the Python that the search found, "" before a search or if it found none."""
    numba, version = find_python.own_numba(), f"Python {sys.version_info[0]}.{sys.version_info[1]}"
    if find_python.is_own(found) or (numba and not found):
        return f"Blender's own {version} with {numba} numba", "CHECKMARK"
    lacking = "" if numba else f"; this build of the extension has no numba wheel for {version}"
    if found:
        return f"Found: {found}{lacking or ', which also has torch'}", "INFO"
    return f"No Python with numba found yet{lacking}; the first render searches for one", "ERROR"


def get() -> "R5DGS_AP_preferences | None":
    """Return the preferences, or None if the code is registered without being enabled as an extension."""
    addon = bpy.context.preferences.addons.get(base_package)
    return addon.preferences if addon else None


@dataclass(frozen=True)
class Snapshot:
    """Immutable copy of the preferences, safe to use from any thread.

    Attributes:
        chosen: Python set by the environment, the preferences or ``r5dgs config --user``, in this order; "" to search.
        kept: Result of an earlier search, or "".
        beside: Folders of the extension, beside which environments are searched.
        timeout_s: Seconds to wait for a response from the worker.
        trusted: Folders from which any .blend may load scene files.
        kernels: Folder for the kernels that Blender's own Python compiles; "" outside an installed extension.
    """

    chosen: str
    kept: str
    beside: tuple[Path, ...]
    timeout_s: float
    trusted: tuple[str, ...] = ()
    kernels: str = ""

    def known(self) -> str | None:
        """Return the Python if no search is needed, otherwise None."""
        if self.chosen:
            return self.chosen
        found = (self.kept or None) if _found is None else _found
        if found is None or (found and not Path(found).is_file()):
            return None
        return found or sys.executable

    def python(self, stopped: Callable[[], bool] = lambda: False) -> str:
        """Return the Python, searching for it if needed. The search may take seconds; its result is cached.

        Falls back to Blender's own Python; the worker then reports the missing packages.

        Args:
            stopped: Callback that returns True to abort the search; its result is then not cached.
        """
        global _found
        known = self.known()
        if known is not None:
            return known
        found = find_python.find(list(self.beside), stopped=stopped) or ""
        if not stopped():
            _found = found
        return found or sys.executable


def snapshot() -> Snapshot:
    """Return a snapshot of the preferences. Outside the main thread, this is the last snapshot taken there."""
    global _last
    if not _may_touch_blender() and _last is not None:
        return _last
    keep_found()
    preferences = get()
    chosen = os.environ.get(ENVIRONMENT, "").strip()
    if not chosen and preferences is not None:
        chosen = preferences.worker_python.strip()
    chosen = chosen or _of_user_settings()
    _last = Snapshot(
        chosen=_absolute(chosen) if chosen else "",
        kept=preferences.found_python if preferences is not None else "",
        beside=tuple(_beside()),
        timeout_s=float(preferences.worker_timeout) if preferences is not None else 120.0,
        trusted=_trusted(preferences),
        kernels=_kernels(),
    )
    return _last


def _kernels() -> str:
    """Folder in the extension's user folder, which Blender removes with the extension."""
    try:
        return bpy.utils.extension_path_user(base_package, path="kernels")
    except ValueError:  # the package is not installed as an extension
        return ""


def _of_user_settings() -> str:
    """``worker_python`` of ``r5dgs config --user``, or "" if unset. A faulty file gives "" and a warning."""
    try:
        return user_settings.read().get("worker_python", "")
    except errors.ConfigError as error:
        _warn_once(str(error))
        return ""


@functools.cache
def _warn_once(message: str) -> None:
    log.warning("worker: %s", message)


def worker_python() -> str:
    """Return the Python for the worker, see `Snapshot.python`. Blocks until the search has finished."""
    found = snapshot().python()
    keep_found()
    return found


def text_encoder() -> str:
    """Text encoder for words that scenes do not store, from the environment or the preferences; "" if unset."""
    preferences = get()
    chosen = os.environ.get(ENCODER_ENVIRONMENT, "").strip()
    if not chosen and preferences is not None:
        chosen = preferences.text_encoder.strip()
    return _absolute(chosen) if chosen not in ("", INSTALLED) else chosen


def keep_found() -> None:
    """Save the search result in the preferences for later sessions. Does nothing outside the main thread."""
    preferences = get() if _found is not None and _may_touch_blender() else None
    if preferences is not None and preferences.found_python != _found:
        preferences.found_python = _found


def forget() -> None:
    """Discard the search result, so that the next `Snapshot` searches again."""
    global _found
    _found = None
    preferences = get()
    if preferences is not None and preferences.found_python:
        preferences.found_python = ""


def trust(folder: str) -> None:
    """Add a trusted folder for this session, and for later ones if Blender saves its preferences."""
    preferences = get()
    if preferences is not None:
        preferences.trusted_folders = os.pathsep.join(filter(None, (preferences.trusted_folders, folder)))
        bpy.context.preferences.is_dirty = True


def _trusted(preferences: "R5DGS_AP_preferences | None") -> tuple[str, ...]:
    named = preferences.trusted_folders if preferences is not None else ""
    entries = f"{named}{os.pathsep}{os.environ.get(TRUSTED_ENVIRONMENT, '')}".split(os.pathsep)
    return tuple(str(Path(entry.strip()).expanduser()) for entry in entries if entry.strip())


def _absolute(path: str) -> str:
    """Resolve a path that may begin with ``//`` (the .blend's folder) or ``~``."""
    blend = getattr(bpy.data, "filepath", "")  # missing while Blender registers extensions at startup
    return str(Path(bpy.path.abspath(path, start=os.path.dirname(blend))).expanduser())


def _may_touch_blender() -> bool:
    """True in Blender's main thread. Renders in a window and worker jobs run in other threads."""
    return threading.current_thread() is threading.main_thread()


def _beside() -> list[Path]:
    """Folders that belong to the extension: its user folder and its code."""
    try:
        own = [Path(bpy.utils.extension_path_user(base_package))]
    except ValueError:  # not enabled as an extension
        own = []
    return [*own, ROOT]


def register():
    """Register the preferences class and take a first snapshot for other threads."""
    bpy.utils.register_class(R5DGS_AP_preferences)
    snapshot()


def unregister():
    """Undo `register`."""
    bpy.utils.unregister_class(R5DGS_AP_preferences)
