"""Atomic replacement of files: after any interruption, a file holds either its old or its new content."""

from __future__ import annotations

import logging
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

logger = logging.getLogger(__name__)


@contextmanager
def replacing(path: str | Path, previous: str | Path | None = None) -> Iterator[BinaryIO]:
    """Open a stream for the new content of a file, which replaces the file if the block ends without an error.

    The content is written to a hidden temporary file in the same folder, flushed to disk and renamed. After an error
    the temporary file is removed and the old file is unchanged.

    Args:
        path: The file; its folder must exist.
        previous: New path of the old file, in the same folder; None drops the old file. A kill between the two renames
            leaves the old content there and no file at ``path``.

    Raises:
        OSError: The file cannot be written.
    """
    path = Path(path)
    temporary = _temporary(path, ".part")
    created = open(temporary, "xb")  # noqa: SIM115  # exclusive: never overwrite or remove a file of others
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
    """Yield the path of an empty temporary file, for libraries that open files themselves; see `replacing`.

    The path has the suffix of ``path``.

    Raises:
        OSError: The file cannot be created or renamed.
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
    """Replace a file by ``content``; see `replacing`."""
    with replacing(path) as stream:
        stream.write(content)


def leftovers(path: str | Path) -> list[Path]:
    """Return temporary files of `replacing` beside a file, of killed processes or of writes in progress."""
    path = Path(path)
    return [p for p in path.parent.glob(f".{path.name}.*.part") if p.is_file()]


def leftovers_by_name(path: str | Path) -> list[Path]:
    """Return temporary files of `replacing_by_name` beside a file, of killed processes or of writes in progress."""
    path = Path(path)
    temporary = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{16}}{re.escape(path.suffix)}")
    return [p for p in path.parent.iterdir() if temporary.fullmatch(p.name)]


def _sync_folder(folder: Path) -> None:
    """Flush the rename to disk if the system supports it (Windows does not)."""
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
