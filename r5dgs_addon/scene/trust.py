"""Rules for reading scene files that a .blend names.

A .blend can come from anybody and name any path, and much is read without a click: Exact Mode on each frame, Rendered
viewports, renders in the background. A file is read if it lies beside or below the .blend that names it, in a trusted
folder of the preferences, or if the user loaded, chose or allowed it in this session. For any other the panel *Scene*
asks. On Windows a network path is not even looked up before that, as the lookup would send the user's credentials.
"""

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import bpy

from .. import preferences

ENVIRONMENT = preferences.TRUSTED_ENVIRONMENT

_allowed: set[str] = set()  # files that the user loaded, chose or allowed in this session


@dataclass(frozen=True)
class Found:
    """Result of the search for the file of a loaded scene.

    Attributes:
        path: The file to read; None if none was found that may be read.
        asked: The file that the user has to allow first; None if there is none.
    """

    path: Path | None = None
    asked: Path | None = None


def _library(collection: bpy.types.Collection) -> bpy.types.Library | None:
    """The .blend that a loaded scene is linked from, or overrides; None for one of the open .blend."""
    override = collection.override_library
    return collection.library or (override.reference.library if override and override.reference else None)


def folders(collection: bpy.types.Collection) -> list[str]:
    """Folders of the .blend files that name the file of a loaded scene: the library's, and that of the open one.

    The library's counts only if the linked scene itself names the file: of an override, the open .blend stores the
    file's path, and the path of a library that need not exist.
    """
    library, override = _library(collection), collection.override_library
    named = library is not None and (override is None or override.reference.r5dgs.filepath == collection.r5dgs.filepath)
    blends = [bpy.path.abspath(library.filepath)] if named else []
    return [str(Path(blend).parent) for blend in (*blends, bpy.data.filepath) if blend]


def places(collection: bpy.types.Collection) -> list[Path]:
    """Possible paths of the file of a loaded scene, likeliest first.

    These are the stored path, relative to the library for linked data; the folder of the open .blend, as both files may
    have moved together; and the place where the file was last seen, as appended data comes from a .blend elsewhere.
    """
    stored = Path(bpy.path.abspath(collection.r5dgs.filepath, library=_library(collection)))
    found = [stored]
    if bpy.data.filepath:
        found.append(Path(bpy.path.abspath("//")) / stored.name)
    if collection.r5dgs.seen_at:
        found.append(Path(collection.r5dgs.seen_at))
    return found


def find(collection: bpy.types.Collection) -> Found:
    """Return the first of `places` that exists, or ask for it if it may not be read."""
    trusted = [*folders(collection), *preferences.choice().trusted]
    asked = None
    for place in places(collection):
        if may_read(place, trusted):
            if place.is_file():
                return Found(path=place)
        elif on_network(place):
            asked = asked or place  # whether it exists is not known
        elif place.is_file():
            return Found(asked=asked or Path(os.path.realpath(place)))  # the user sees what a link leads to
    return Found(asked=asked)


def may_read(place: Path, folders: list[str]) -> bool:
    """Return True if a file was allowed in this session, or lies in or below a folder once links are followed."""
    given = _key(os.path.abspath(place))
    if given in _allowed:
        return True
    if on_network(place) and not any(_inside(given, _key(os.path.abspath(folder))) for folder in folders):
        return False
    real = _key(os.path.realpath(place))
    return real in _allowed or any(_inside(real, _key(os.path.realpath(folder))) for folder in folders)


def allow(place: Path) -> None:
    """Let a file be read until Blender ends."""
    _allowed.update((_key(os.path.abspath(place)), _key(os.path.realpath(place))))


def on_network(place: Path, windows: bool = os.name == "nt") -> bool:
    """Return True for a path of the form ``\\\\server\\share`` on Windows or a device path, which can name one."""
    return windows and str(place).replace("/", "\\").startswith("\\\\")


def choose(state: bpy.types.PropertyGroup, _: bpy.types.Context) -> None:
    """Allow the file that the user, or a script, has entered as *Scene File*."""
    if not _following:
        allow(places(state.id_data)[0])


_following: list[bool] = []  # not empty while the add-on itself writes paths


@contextlib.contextmanager
def following() -> Iterator[None]:
    """Let the block write *Scene File* without allowing what it writes."""
    _following.append(True)
    try:
        yield
    finally:
        _following.pop()


def _key(path: str) -> str:
    return os.path.normcase(path)


def _inside(path: str, folder: str) -> bool:
    return path.startswith(os.path.join(folder, ""))
