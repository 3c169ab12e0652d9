"""Registry of the layouts, and detection of the layout of a folder."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

from ... import errors, input_paths
from .. import file_kinds

CAMERAS_FILE = "transforms_train.json"  # of the layout `camera_files`
MODULES = ["camera_files", "colmap"]  # modules of this folder; the first that detects its files reads the folder


def find(root: Path) -> ModuleType:
    """Return the module of a data set's layout: ``detect(root) -> bool`` and ``read(root, min_registered, guard)``.

    Raises:
        DatasetError: The path is not a folder, or has no known layout.
        OSError: The folder cannot be read.
    """
    if not root.is_dir():
        video = root.is_file() and root.suffix.lower() in file_kinds.VIDEOS
        remedy = f". Remedy: make a data set of it: {input_paths.prepare_command(root)}" if video else ""
        raise errors.DatasetError(
            f"{root}: expected a data set folder, found {'a file' if root.exists() else 'nothing'}{remedy}"
        )
    for name in MODULES:
        module = importlib.import_module(f".{name}", __package__)
        if module.detect(root):
            return module
    _check_recordings(root)
    command = input_paths.prepare_command(root)
    remedy = "is it the right folder?"
    if (root / "transforms.json").exists():
        remedy = f"make a data set of it with '{command}'"
    elif any(path.suffix.lower() in file_kinds.IMAGES for path in root.glob("[!.]*/*")):
        remedy = f"is it the right folder? '{command}' makes a data set of folders of frames"
    raise errors.DatasetError(f"{root / CAMERAS_FILE}: the file is missing; {remedy}")


def _check_recordings(root: Path) -> None:
    """Raise `DatasetError` with the command that makes a data set of videos, if the folder has any."""
    inside = [path for path in root.iterdir() if path.is_dir() and not path.name.startswith(".")]
    for folder in (root, *inside):
        video = next((path for path in sorted(folder.iterdir()) if path.suffix.lower() in file_kinds.VIDEOS), None)
        if video is not None:
            raise errors.DatasetError(
                f"{root}: expected images and camera files, found videos ({video.name}). Remedy: make a data set of "
                f"them: {input_paths.prepare_command(root)}"
            )


def check(root: Path) -> None:
    """Raise `DatasetError` if a path is not a folder in a known layout; `find` reports missing permissions later."""
    try:
        find(root)
    except OSError:
        return
