"""Save handlers that keep the stored path of scene files valid when the .blend is saved elsewhere."""

import os
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from . import trust


def relative_to(path: str, blend_path: str) -> str:
    """Make a path relative to a .blend file (Blender's ``//``), or keep it absolute if that is impossible.

    Args:
        path: Absolute path.
        blend_path: Path of the .blend file, or "" if unsaved.

    Returns:
        Path to store.
    """
    if not blend_path:
        return path
    try:
        return "//" + os.path.relpath(path, Path(blend_path).parent).replace("\\", "/")
    except ValueError:  # another drive
        return path


_open_file: list[tuple[str, dict[int, str]]] = []  # before saving: open .blend, and its paths by session_uid


@persistent
def _relink_before_save(target, *_):
    """Rewrite the stored paths relative to the .blend file that is about to be written."""
    target = target if isinstance(target, str) and target else bpy.data.filepath
    _open_file.clear()
    if not target:
        return
    scenes = _own_scenes()
    _open_file.append((bpy.data.filepath, {scene.session_uid: scene.r5dgs.filepath for scene in scenes}))
    for collection in scenes:
        place = trust.find(collection)
        found = place.path or place.asked
        if found is not None and not trust.on_network(found):
            with trust.following():
                collection.r5dgs.filepath = relative_to(str(found.resolve()), target)
            collection.r5dgs.seen_at = str(found.resolve())


@persistent
def _restore_after_save(target, *_):
    """Restore the stored paths if the open .blend is still another file (*Save Copy*, a failed save)."""
    if not _open_file:
        return
    open_file, paths = _open_file.pop()
    if bpy.data.filepath != open_file or target == open_file:
        return
    for collection in _own_scenes():
        stored = paths.get(collection.session_uid)
        if stored is not None:
            with trust.following():
                collection.r5dgs.filepath = stored


def _own_scenes() -> list[bpy.types.Collection]:
    """Loaded scenes stored in this .blend; linked scenes and library overrides belong to their library."""
    every = bpy.data.collections
    return [c for c in every if c.r5dgs.is_scene and c.library is None and c.override_library is None]


def _hooks():
    handlers = bpy.app.handlers
    return (
        (handlers.save_pre, _relink_before_save),
        (handlers.save_post, _restore_after_save),
        (handlers.save_post_fail, _restore_after_save),
    )


def register():
    """Register the save handlers."""
    for events, handler in _hooks():
        events.append(handler)


def unregister():
    """Undo `register`."""
    for events, handler in _hooks():
        if handler in events:
            events.remove(handler)
