"""Access rules for the scene files that a .blend names.

A .blend from an untrusted source can name any path, and many reads happen without a click: Exact Mode at each frame,
Rendered viewports, background renders. A file may be read if it is in the folder of the .blend that names it or below,
in a trusted folder of the preferences, or if the user loaded, chose or allowed it in this session. For other files,
the *Scene* panel asks the user. On Windows, network paths are not even looked up before that, because the lookup would
send the user's credentials.
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
class SceneFileSearch:
    """Result of the search for the file of a loaded scene.

    Attributes:
        path: File to read, or None if no readable file was found.
        asked: File that the user must allow first, or None.
    """

    path: Path | None = None
    asked: Path | None = None


def _library(collection: bpy.types.Collection) -> bpy.types.Library | None:
    """Library that a loaded scene is linked from or overrides, or None if it is local."""
    override = collection.override_library
    return collection.library or (override.reference.library if override and override.reference else None)


def folders(collection: bpy.types.Collection) -> list[str]:
    """Folders of the .blend files that name the file of a loaded scene: the library and the open .blend.

    The library counts only if the linked scene itself names the file. For an override, the open .blend stores both the
    file's path and the path of the library, which need not exist.
    """
    library, override = _library(collection), collection.override_library
    named = library is not None and (override is None or override.reference.r5dgs.filepath == collection.r5dgs.filepath)
    blends = [bpy.path.abspath(library.filepath)] if named else []
    return [str(Path(blend).parent) for blend in (*blends, bpy.data.filepath) if blend]


def places(collection: bpy.types.Collection) -> list[Path]:
    """Possible paths of the file of a loaded scene, most likely first.

    These are the stored path, relative to the library for linked data; the same name in the folder of the open .blend,
    as both files may have moved together; and the last known location, as appended data comes from another .blend.
    """
    stored = Path(bpy.path.abspath(collection.r5dgs.filepath, library=_library(collection)))
    found = [stored]
    if bpy.data.filepath:
        found.append(Path(bpy.path.abspath("//")) / stored.name)
    if collection.r5dgs.seen_at:
        found.append(Path(collection.r5dgs.seen_at))
    return found


def find(collection: bpy.types.Collection) -> SceneFileSearch:
    """Return the first existing path of `places` that may be read, or the path that the user must allow."""
    trusted = [*folders(collection), *preferences.snapshot().trusted]
    asked = None
    for place in places(collection):
        if may_read(place, trusted):
            if place.is_file():
                return SceneFileSearch(path=place)
        elif on_network(place):
            asked = asked or place  # network path: not even looked up, so it is not known if the file exists
        elif place.is_file():
            return SceneFileSearch(asked=asked or Path(os.path.realpath(place)))  # show the target of a link
    return SceneFileSearch(asked=asked)


def may_read(place: Path, folders: list[str]) -> bool:
    """Return True if a file was allowed in this session, or is in or below one of the folders after resolving links."""
    given = _key(os.path.abspath(place))
    if given in _allowed:
        return True
    if on_network(place) and not any(_inside(given, _key(os.path.abspath(folder))) for folder in folders):
        return False
    real = _key(os.path.realpath(place))
    return real in _allowed or any(_inside(real, _key(os.path.realpath(folder))) for folder in folders)


def allow(place: Path) -> None:
    """Allow a file to be read until Blender exits."""
    _allowed.update((_key(os.path.abspath(place)), _key(os.path.realpath(place))))


def on_network(place: Path, windows: bool = os.name == "nt") -> bool:
    """Return True for UNC or device paths (``\\\\server\\share``) on Windows."""
    return windows and str(place).replace("/", "\\").startswith("\\\\")


def choose(state: bpy.types.PropertyGroup, _: bpy.types.Context) -> None:
    """Allow the file that the user or a script entered as *Scene File*."""
    if not _following:
        allow(places(state.id_data)[0])


_following: list[bool] = []  # not empty while the extension itself writes paths


@contextlib.contextmanager
def following() -> Iterator[None]:
    """Let the ``with`` block change *Scene File* without allowing the new path."""
    _following.append(True)
    try:
        yield
    finally:
        _following.pop()


def _key(path: str) -> str:
    return os.path.normcase(path)


def _inside(path: str, folder: str) -> bool:
    return path.startswith(os.path.join(folder, ""))
