"""Folders of frames that several processes may fill together (`shared_frames`).

All processes must have the same settings: the first one writes them to ``render.json``, the others compare. Frames are
removed only from folders that have this file.
"""

from __future__ import annotations

import json
import os
import re
import secrets
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from .. import atomic_files, errors, shared_frames, strict_json
from .schedule import Shot

SETTINGS = "render.json"
KEYS = {"scene", "camera", "gaussians"}  # by which the file is known to be of a film
_FRAME = re.compile(r"frame_\d{4,}\.(png|exr)")


def path_of(folder: Path, number: int, suffix: str) -> Path:
    """Return the path of a frame."""
    return folder / f"frame_{number:04d}{suffix}"


def create(folder: Path) -> None:
    """Create a folder if it is missing. Raises ConfigError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise errors.ConfigError(f"--out {folder}: the folder cannot be created ({error})") from error


def fill(
    folder: Path, shots: Sequence[Shot], suffix: str, draw: Callable[[Shot, Path], None], *, share: bool
) -> Iterator[tuple[Shot, bool]]:
    """Write the frames of a folder.

    Args:
        folder: The folder, which must exist.
        shots: The frames.
        suffix: Suffix of their files.
        draw: Draws a frame and writes it atomically.
        share: True to leave existing frames, and to wait for the frames of other processes at the end.

    Yields:
        Each frame when it is complete, and True if this process has drawn it.
    """
    frames = [(shot, path_of(folder, shot.number, suffix)) for shot in shots]
    if share:
        yield from shared_frames.fill(frames, draw)
        return
    for shot, path in frames:
        draw(shot, path)
        yield shot, True


def claim(folder: Path, settings: dict[str, Any], *, overwrite: bool = False) -> None:
    """Write the settings of the frames of a folder, or compare them with those that it has.

    Args:
        folder: The folder.
        settings: Everything that determines the frames, with the keys `KEYS` at least.
        overwrite: True to remove the frames of other settings.

    Raises:
        ConfigError: The folder has frames with other settings or of another program, or cannot be written.
    """
    path = folder / SETTINGS
    try:
        frames = [p for p in folder.iterdir() if _FRAME.fullmatch(p.name) and p.is_file()]
        if not path.exists():  # after the list of frames: all processes write the settings first
            if frames:
                raise errors.ConfigError(
                    f"{min(frames)}: not a frame of 'r5dgs render' (the folder has no {SETTINGS}); use another folder"
                )
            if _create_settings(path, settings):
                return
        found = strict_json.read(path, errors.ConfigError)
        if not (isinstance(found, dict) and found.keys() >= KEYS):
            raise errors.ConfigError(f"{path}: not the settings of a film; use another folder")
        other = [key for key in settings | found if found.get(key) != settings.get(key)]
        if other and not overwrite:
            raise errors.ConfigError(
                f"{path}: the folder has frames with other settings ({', '.join(other)}); use those or another folder, "
                "or replace all frames with --overwrite"
            )
        if other:
            for frame in frames:
                frame.unlink(missing_ok=True)
            atomic_files.write(path, json.dumps(settings, indent=1).encode())
    except OSError as error:
        raise errors.ConfigError(f"--out {folder}: cannot be written ({error.strerror or error})") from error


def _create_settings(path: Path, settings: dict[str, Any]) -> bool:
    """Write the settings if there are none yet; returns False if another process was faster."""
    temporary = path.with_name(f".{SETTINGS}.{secrets.token_hex(8)}")
    try:
        atomic_files.write(temporary, json.dumps(settings, indent=1).encode())
        os.link(temporary, path)  # fails if the file exists, and never leaves half of it
    except FileExistsError:
        return False
    except OSError:
        if not temporary.exists():
            raise
        os.replace(temporary, path)  # on file systems without hard links
    finally:
        temporary.unlink(missing_ok=True)
    return True
