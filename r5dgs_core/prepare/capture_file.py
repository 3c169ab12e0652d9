"""``capture.json``: the record of a prepared data set, from which an interrupted command continues."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from .. import atomic_files, errors, strict_json

FILE = "capture.json"
FORMAT_VERSION = 1


def read(folder: Path) -> dict[str, Any] | None:
    """Read the record of a data set; returns None without the file.

    Raises:
        DatasetError: The file is damaged or of another version.
    """
    path = Path(folder) / FILE
    if not path.exists():
        return None
    content = strict_json.read(path, errors.DatasetError)
    version = content.get("format_version") if isinstance(content, dict) else None
    if version != FORMAT_VERSION:
        raise errors.DatasetError(f"{path}: expected 'format_version' {FORMAT_VERSION}, found {version!r}")
    return content


def write(folder: Path, content: dict[str, Any]) -> None:
    """Write the record atomically."""
    write_json(Path(folder) / FILE, {"format_version": FORMAT_VERSION, **content})


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically.

    Raises:
        DatasetError: The file cannot be written.
    """
    try:
        atomic_files.write(path, (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode())
    except OSError as error:
        raise errors.DatasetError(f"{path}: cannot be written: {error}") from error
