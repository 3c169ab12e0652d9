"""Frames that several processes draw together into one folder, without losing or repeating one.

A process holds a locked placeholder beside a frame while it draws it. The system releases the lock when the process
ends in any way, so the frames of a process that was killed are drawn by the others.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from . import atomic_files, folder_lock

T = TypeVar("T")

POLL_S = 0.5  # interval between two checks for frames of other processes


def fill(frames: Iterable[tuple[T, Path]], draw: Callable[[T, Path], None]) -> Iterator[tuple[T, bool]]:
    """Draw the missing frames, and wait for those of other processes at the end.

    Args:
        frames: The frames and their files, whose folder must exist. An empty file counts as missing: Blender's own
            placeholders are empty files, which stay if it is killed.
        draw: Draws a frame and gives the file its name when it is complete.

    Yields:
        Each frame when it is complete, and True if this process has drawn it.

    Raises:
        CheckpointError: A placeholder cannot be created.
    """
    waiting = list(frames)
    while waiting:
        left = []
        for frame, path in waiting:
            drawn = _draw_once(frame, path, draw)
            if drawn is None:
                left.append((frame, path))
            else:
                yield frame, drawn
        if len(left) == len(waiting):
            time.sleep(POLL_S)
        waiting = left


def _draw_once(frame: T, path: Path, draw: Callable[[T, Path], None]) -> bool | None:
    """Draw a frame unless it exists (False) or another process draws it (None)."""
    if _is_drawn(path):
        return False
    with folder_lock.try_file(path.with_name(f".{path.name}.placeholder")) as held:
        if not held:
            return None
        if _is_drawn(path):
            return False
        for left in atomic_files.leftovers_by_name(path):  # of a process that was killed while it wrote
            left.unlink(missing_ok=True)
        draw(frame, path)
    return True


def _is_drawn(path: Path) -> bool:
    return path.exists() and path.stat().st_size > 0
