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
    cameras = content.get("cameras", [])
    if not isinstance(cameras, list) or not all(map(_is_camera, cameras)):
        raise errors.DatasetError(f"{path}: 'cameras' is damaged; copy the file again, or prepare the data set again")
    return content


def _is_camera(row: Any) -> bool:
    """Return True for a row of ``cameras`` with a name, an offset and gaps."""
    if not isinstance(row, dict) or not isinstance(row.get("name"), str):
        return False
    sigma, gaps = row.get("offset_sigma_ms"), row.get("gaps", [])
    measured = _is_number(row.get("offset_ms")) and (sigma is None or _is_number(sigma))
    return measured and isinstance(gaps, list) and all(map(_is_gap, gaps))


def _is_gap(row: Any) -> bool:
    return isinstance(row, dict) and _is_number(row.get("after_frame")) and _is_number(row.get("ms"))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float)


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
