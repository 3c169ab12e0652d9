"""Files that are replaced whole or not at all: whatever happens on the way, the old content or the new is there."""

from __future__ import annotations

import logging
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

logger = logging.getLogger(__name__)


@contextmanager
def replacing(path: str | Path, previous: str | Path | None = None) -> Iterator[BinaryIO]:
    """A stream for the new content of a file, which becomes the file when the block ends without an error.

    The content goes under a hidden temporary name in the same folder, then to the disk, then to its place. After an
    error the temporary file is gone and the old one untouched.

    Args:
        path: The file; its folder must exist.
        previous: Place of the old file from then on, in the same folder; None to drop it. A kill between the two moves
            leaves the old content there and nothing at ``path``.

    Raises:
        OSError: It cannot be written.
    """
    path = Path(path)
    temporary = _temporary(path, ".part")
    created = open(temporary, "xb")  # noqa: SIM115  # exclusive: what others put there is neither written nor removed
    try:
        with created as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        if previous is not None and path.exists():
            os.replace(path, previous)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    _sync_folder(path.parent)


@contextmanager
def replacing_by_name(path: str | Path) -> Iterator[Path]:
    """As `replacing`, for libraries that open files themselves: the name of an empty file with the suffix of ``path``.

    Raises:
        OSError: The file cannot be made or moved to its place.
    """
    path = Path(path)
    temporary = _temporary(path, path.suffix)
    open(temporary, "xb").close()
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _temporary(path: Path, suffix: str) -> Path:
    return path.with_name(f".{path.name}.{secrets.token_hex(8)}{suffix}")


def write(path: str | Path, content: bytes) -> None:
    """Replace a file by ``content``, see `replacing`."""
    with replacing(path) as stream:
        stream.write(content)


def leftovers(path: str | Path) -> list[Path]:
    """Temporary files that `replacing` left beside a file when its process was killed, or is writing right now."""
    path = Path(path)
    return [p for p in path.parent.glob(f".{path.name}.*.part") if p.is_file()]


def _sync_folder(folder: Path) -> None:
    """Put the rename itself on the disk, where the system can (not on Windows)."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        logger.debug("%s: fsync of the folder failed: %s", folder, error)
    finally:
        os.close(descriptor)
