"""Times of frames from ``timestamps.csv`` beside the videos; a re-encoded container is less reliable.

    camera,frame,time          also cam_id or port; frame_index or sync_index; frame_time or timestamp, in seconds
    cam_0,0,25.0012            a suffix gives the unit: time_s, time_ms, time_us, time_ns

The rows of a camera, in the order of their frame numbers, are its frames. All cameras share the table's clock.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from .. import errors
from . import names
from .camera_source import TABLE, CameraSource

FILE = "timestamps.csv"
_CAMERA = ("camera", "cam_id", "camera_id", "cam", "port", "view")
_FRAME = ("frame", "frame_index", "frame_id", "sync_index", "index")
_TIME = ("time", "frame_time", "timestamp", "t")
_UNITS = {"": 1.0, "_s": 1.0, "_ms": 1e-3, "_us": 1e-6, "_ns": 1e-9}


def apply(sources: Sequence[CameraSource], path: Path) -> list[CameraSource]:
    """Return the cameras with the times of a table.

    Raises:
        DatasetError: The table is damaged, or does not fit the cameras.
    """
    table = read(path)
    matched = names.match([source.name for source in sources], list(table))
    if matched is None:
        raise errors.DatasetError(
            f"{path}: expected times of {', '.join(source.name for source in sources)}, found {', '.join(table)}; "
            "correct the names, or remove the file"
        )
    result = []
    for source in sources:
        times = table[matched[source.name]]
        if len(times) != len(source.times):
            raise errors.DatasetError(
                f"{path}: lists {len(times)} frames of {source.name}, which has {len(source.times)}; correct the "
                "table, or remove it to use the times of the videos"
            )
        result.append(replace(source, times=times, timing=TABLE))
    return result


def read(path: Path) -> dict[str, np.ndarray]:
    """Read the times of each camera, seconds from the earliest time of all.

    Raises:
        DatasetError: Columns are missing, or a row is damaged.
    """
    try:
        rows = list(csv.DictReader(path.read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, UnicodeError, csv.Error) as error:
        raise errors.DatasetError(f"{path}: cannot be read ({error})") from error
    header = {str(key).strip().lower(): key for key in (rows[0] if rows else {})}
    camera = next((header[key] for key in _CAMERA if key in header), None)
    frame = next((header[key] for key in _FRAME if key in header), None)
    timed = [(header[key + unit], scale) for key in _TIME for unit, scale in _UNITS.items() if key + unit in header]
    if camera is None or not timed:
        raise errors.DatasetError(
            f"{path}: expected the columns camera, frame and time, found {', '.join(header) or 'no rows'}"
        )
    column, scale = timed[0]
    found: dict[str, list[tuple[float, float]]] = {}
    for number, row in enumerate(rows, 2):
        try:
            place = float(row[frame]) if frame is not None else float(number)
            moment = float(row[column]) * scale
            if not np.isfinite([place, moment]).all():
                raise ValueError("not finite")
        except (TypeError, ValueError) as error:
            raise errors.DatasetError(f"{path}: line {number}: expected a frame number and a time ({error})") from error
        found.setdefault(str(row[camera]).strip(), []).append((place, moment))
    first = min(moment for pairs in found.values() for _, moment in pairs)
    result = {}
    for name, pairs in found.items():
        times = np.array([moment - first for _, moment in sorted(pairs)])
        if (np.diff(times) <= 0).any():
            raise errors.DatasetError(f"{path}: the times of {name} do not increase with its frames; correct the table")
        result[name] = times
    return result
