"""Handlers of the .blend file: the path of a scene file follows when the .blend is saved elsewhere."""

import os
from pathlib import Path

import bpy
from bpy.app.handlers import persistent


def relative_to(path: str, blend_path: str) -> str:
    """Write a path relative to a .blend file (Blender's ``//``), absolute where that is impossible.

    Args:
        path: Absolute path.
        blend_path: Path of the .blend file, "" where it was never saved.

    Returns:
        The path to store.
    """
    if not blend_path:
        return path
    try:
        return "//" + os.path.relpath(path, Path(blend_path).parent).replace("\\", "/")
    except ValueError:  # another drive
        return path


@persistent
def _relink_before_save(target, *_):
    """Turn the stored paths so that they hold from where the .blend is about to lie."""
    target = target if isinstance(target, str) and target else bpy.data.filepath
    if not target:
        return
    for collection in bpy.data.collections:
        if collection.r5dgs.is_scene and collection.library is None:
            found = Path(bpy.path.abspath(collection.r5dgs.filepath))
            if found.is_file():
                collection.r5dgs.filepath = relative_to(str(found.resolve()), target)


def register():
    """Listen to saving."""
    bpy.app.handlers.save_pre.append(_relink_before_save)


def unregister():
    """Undo `register`."""
    if _relink_before_save in bpy.app.handlers.save_pre:
        bpy.app.handlers.save_pre.remove(_relink_before_save)
