"""The add-on's preferences: which Python runs the worker, and which encoder it has.

Preferences are read and written in Blender's main thread alone; other threads get a `Choice` that was made there. The
search for a Python touches none of Blender's data, so it runs where there is time for it.
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
from .ui import worker_status

ENVIRONMENT = "R5DGS_PYTHON"
ENCODER_ENVIRONMENT = "R5DGS_TEXT_ENCODER"
TRUSTED_ENVIRONMENT = "R5DGS_TRUSTED_FOLDERS"
INSTALLED = "text"  # in place of a folder: the package of a small text encoder
ROOT = Path(__file__).resolve().parent.parent

log = logging.getLogger(__name__)
_found: str | None = None  # what the search found in this session, "" for nothing; None before it
_chosen: "Choice | None" = None  # what the preferences said last


def _remember(_: bpy.types.AddonPreferences, context: bpy.types.Context) -> None:
    choice()


class R5DGS_AP_preferences(bpy.types.AddonPreferences):
    """Preferences under Edit > Preferences > Add-ons > R5DGS."""

    bl_idname = base_package

    worker_python: StringProperty(
        name="Worker Python",
        description="Python with torch and numba that renders pictures. If empty: that of 'r5dgs config --user', or "
        "the first suitable one in the usual places",
        subtype="FILE_PATH",
        update=_remember,
    )
    worker_timeout: IntProperty(
        name="Timeout",
        description="Seconds to wait for the worker's start and for each answer; the first picture compiles the "
        "rasterizer, which takes a while",
        default=120,
        min=1,
        max=3600,
        subtype="TIME_ABSOLUTE",
        update=_remember,
    )
    text_encoder: StringProperty(
        name="Text Encoder",
        description="Folder of the encoder that made the scenes' lookup tables, for words that they do not store; "
        "'text' for the installed package",
        subtype="DIR_PATH",
    )
    trusted_folders: StringProperty(
        name="Trusted Folders",
        description=f"Folders, separated by '{os.pathsep}', from which any .blend may have scene files read; files "
        "beside and below a .blend need none",
        update=_remember,
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
        elif not self.worker_python and (named := _of_user_settings()):
            layout.label(text=f"From 'r5dgs config --user': {named}", icon="INFO")
        elif not self.worker_python and self.found_python:
            layout.label(text=f"Found: {self.found_python}", icon="INFO")
        layout.prop(self, "worker_timeout")
        layout.prop(self, "text_encoder")
        if os.environ.get(ENCODER_ENVIRONMENT):
            wins = f"{ENCODER_ENVIRONMENT} is set and wins: {os.environ[ENCODER_ENVIRONMENT]}"
            layout.label(text=wins, icon="INFO")
        layout.prop(self, "trusted_folders")
        if os.environ.get(TRUSTED_ENVIRONMENT):
            layout.label(text=f"And {TRUSTED_ENVIRONMENT}: {os.environ[TRUSTED_ENVIRONMENT]}", icon="INFO")
        worker_status.draw(layout, context)


def get() -> "R5DGS_AP_preferences | None":
    """The preferences, or None where the add-on was registered without being enabled as an extension."""
    addon = bpy.context.preferences.addons.get(base_package)
    return addon.preferences if addon else None


@dataclass(frozen=True)
class Choice:
    """The preferences as other threads need them. Any thread may use it.

    Attributes:
        chosen: That of the environment, of the preferences or of ``r5dgs config --user``, in this order; "" for the
            first one found that will do.
        kept: What an earlier search found; "" for nothing.
        beside: Folders that are the extension's own, where the search begins.
        timeout_s: Seconds to wait for an answer of the worker.
        trusted: Folders from which any .blend may have scene files read.
    """

    chosen: str
    kept: str
    beside: tuple[Path, ...]
    timeout_s: float
    trusted: tuple[str, ...] = ()

    def known(self) -> str | None:
        """The Python, where no search is needed; else None."""
        if self.chosen:
            return self.chosen
        found = (self.kept or None) if _found is None else _found
        if found is None or (found and not Path(found).is_file()):
            return None
        return found or sys.executable

    def python(self, stopped: Callable[[], bool] = lambda: False) -> str:
        """The Python, searched for where need be, which may take a while; what is found is remembered.

        Where nothing will do, Blender's own is named: the worker says what it lacks.

        Args:
            stopped: Whether to give the search up; nothing is remembered then.
        """
        global _found
        known = self.known()
        if known is not None:
            return known
        found = find_python.find(list(self.beside), stopped=stopped) or ""
        if not stopped():
            _found = found
        return found or sys.executable


def choice() -> Choice:
    """What the preferences say at present; in another thread than Blender's main one, what they said last there."""
    global _chosen
    if not _may_touch_blender() and _chosen is not None:
        return _chosen
    keep_found()
    preferences = get()
    chosen = os.environ.get(ENVIRONMENT, "").strip()
    if not chosen and preferences is not None:
        chosen = preferences.worker_python.strip()
    chosen = chosen or _of_user_settings()
    _chosen = Choice(
        chosen=_absolute(chosen) if chosen else "",
        kept=preferences.found_python if preferences is not None else "",
        beside=tuple(_beside()),
        timeout_s=float(preferences.worker_timeout) if preferences is not None else 120.0,
        trusted=_trusted(preferences),
    )
    return _chosen


def _of_user_settings() -> str:
    """``worker_python`` of ``r5dgs config --user``; "" if it is not set, or if the file is faulty, with a warning."""
    try:
        return user_settings.read().get("worker_python", "")
    except errors.ConfigError as error:
        _warn_once(str(error))
        return ""


@functools.cache
def _warn_once(message: str) -> None:
    log.warning("worker: %s", message)


def worker_python() -> str:
    """Python to start the worker with, see `Choice.python`; it waits for the search."""
    found = choice().python()
    keep_found()
    return found


def text_encoder() -> str:
    """The encoder for words that scenes do not store: the environment's, or the user's; "" for none."""
    preferences = get()
    chosen = os.environ.get(ENCODER_ENVIRONMENT, "").strip()
    if not chosen and preferences is not None:
        chosen = preferences.text_encoder.strip()
    return _absolute(chosen) if chosen not in ("", INSTALLED) else chosen


def keep_found() -> None:
    """Write what the search has found into the preferences, for later sessions; only the main thread does."""
    preferences = get() if _found is not None and _may_touch_blender() else None
    if preferences is not None and preferences.found_python != _found:
        preferences.found_python = _found


def forget() -> None:
    """Have the next `Choice` search again."""
    global _found
    _found = None
    preferences = get()
    if preferences is not None and preferences.found_python:
        preferences.found_python = ""


def trust(folder: str) -> None:
    """Add a folder to the trusted ones, for this session and, if Blender saves preferences, for later ones."""
    preferences = get()
    if preferences is not None:
        preferences.trusted_folders = os.pathsep.join(filter(None, (preferences.trusted_folders, folder)))
        bpy.context.preferences.is_dirty = True


def _trusted(preferences: "R5DGS_AP_preferences | None") -> tuple[str, ...]:
    named = preferences.trusted_folders if preferences is not None else ""
    entries = f"{named}{os.pathsep}{os.environ.get(TRUSTED_ENVIRONMENT, '')}".split(os.pathsep)
    return tuple(str(Path(entry.strip()).expanduser()) for entry in entries if entry.strip())


def _absolute(path: str) -> str:
    """A path that may begin with ``//``, the folder of the .blend, or with ``~``."""
    blend = getattr(bpy.data, "filepath", "")  # none while Blender starts and registers its extensions
    return str(Path(bpy.path.abspath(path, start=os.path.dirname(blend))).expanduser())


def _may_touch_blender() -> bool:
    """Whether this is Blender's main thread; a render in a window and what waits for the worker run in others."""
    return threading.current_thread() is threading.main_thread()


def _beside() -> list[Path]:
    """Folders that are the extension's own: its code's, and what Blender gives it for files of the user."""
    try:
        own = [Path(bpy.utils.extension_path_user(base_package))]
    except ValueError:  # not enabled as an extension
        own = []
    return [*own, ROOT]


def register():
    """Register the preferences' class, and read what they say for threads that may not."""
    bpy.utils.register_class(R5DGS_AP_preferences)
    choice()


def unregister():
    """Undo `register`."""
    bpy.utils.unregister_class(R5DGS_AP_preferences)
