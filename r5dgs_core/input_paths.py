"""Checks of path arguments. Needs only the standard library, so that a wrong path is reported at once.

A path without read permission passes: the code that opens it reports the reason.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable
from pathlib import Path

from . import errors

SCENE_SUFFIX = ".r5dgs"
RUN_FILE = "run.json"


def check_run(folder: Path) -> None:
    """Raise `CheckpointError` if a path is not a run folder."""
    if not _holds((folder / RUN_FILE).is_file):
        raise errors.CheckpointError(f"{folder}: not a run folder (no {RUN_FILE}); make one with 'r5dgs train'")


def check_foreign_run(folder: Path) -> None:
    """Raise `CheckpointError` if a path is not a folder; the importer checks its layout."""
    if not _holds(folder.is_dir):
        raise errors.CheckpointError(
            f"{folder}: expected a run folder, or a .glb or .4dgs file, found {_found(folder)}"
        )


def check_scene(path: Path) -> None:
    """Raise `SceneFileError` if a path is not a file."""
    if not _holds(path.is_file):
        found = "nothing; look for its new place, or bake it again"
        if path.is_dir():
            made = "bake' makes one from a run" if (path / RUN_FILE).exists() else "train' makes a run from images"
            found = f"a folder; 'r5dgs {made}"
        raise errors.SceneFileError(f"{path}: expected a {SCENE_SUFFIX} file, found {found}")


def check_target(path: Path) -> None:
    """Raise `CheckpointError` or `SceneFileError` if a path is neither a run folder nor a file."""
    if not _holds(path.exists):
        raise errors.SceneFileError(f"{path}: expected a run folder or a {SCENE_SUFFIX} file, found {_found(path)}")
    if _holds(path.is_dir):
        check_run(path)
    else:
        check_scene(path)


def check_scene_output(out: Path, made: Path | None = None) -> None:
    """Check the output path of a scene file: its suffix, which Blender's file browser filters by, and its folder.

    Args:
        out: The output path.
        made: Folder that the command creates before it writes the scene file, if any.

    Raises:
        UsageError: The name has another suffix.
        SceneFileError: The path is a folder, or lies in a folder that does not exist or cannot be written.
    """
    if out.is_dir():
        raise errors.SceneFileError(f"{out}: is a folder; name the file, for example {out / 'scene.r5dgs'}")
    if out.suffix.lower() != SCENE_SUFFIX:
        raise errors.UsageError(f"{out}: expected a name that ends in {SCENE_SUFFIX}, which Blender filters files by")
    if made is not None and not made.exists() and out.parent.absolute() == made.absolute():
        return
    if not out.parent.is_dir():
        raise errors.SceneFileError(f"{out}: expected the folder {out.parent} to exist; create it first")
    if not _is_writable(out.parent):
        raise errors.SceneFileError(f"{out}: {_not_writable(out.parent)}")


def check_output(option: str, path: Path | None) -> None:
    """Raise `ConfigError` if the file that an option names is a folder, or its folder is missing or not writable."""
    if path is not None and (path.is_dir() or not path.parent.is_dir()):
        expected = "a file" if path.is_dir() else f"the folder {path.parent} to exist; create it first"
        raise errors.ConfigError(f"{option} {path}: expected {expected}")
    if path is not None and not _is_writable(path.parent):
        raise errors.ConfigError(f"{option} {path}: {_not_writable(path.parent)}")


def check_output_folder(option: str, path: Path) -> None:
    """Raise `ConfigError` if the path of an output folder is a file."""
    if path.exists() and not path.is_dir():
        raise errors.ConfigError(f"{option} {path}: expected a folder or an unused path, found a file")


def check_source(source: Path) -> None:
    """Raise `DatasetError` if a source of recordings does not exist."""
    if not source.exists():
        raise errors.DatasetError(f"{source}: expected a video, or a folder of videos or frames, found nothing")


def check_calibration(path: Path) -> None:
    """Raise `DatasetError` if the file or folder of ``--calibration`` does not exist."""
    if not path.exists():
        raise errors.DatasetError(f"--calibration {path}: expected a file or folder, found nothing")


def prepare_command(source: Path) -> str:
    """Return the command that makes a data set from a video, or a folder of videos or images, for messages."""
    named = source if source.name not in ("", "..") else source.resolve()  # "." has no name
    name = named.stem if source.is_file() else named.name
    out = named.with_name(f"{name}_data") if name else Path("data")
    return f"r5dgs prepare {shlex.quote(str(source))} --out {shlex.quote(str(out))}"


def _is_writable(folder: Path) -> bool:
    return os.access(folder, os.W_OK | os.X_OK)


def _not_writable(folder: Path) -> str:
    return f"no write access to the folder {folder}; choose another folder"


def _found(path: Path) -> str:
    return "a file" if path.exists() else "nothing"


def _holds(test: Callable[[], bool]) -> bool:
    try:
        return test()
    except OSError:
        return True
