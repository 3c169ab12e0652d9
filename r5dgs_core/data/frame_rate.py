"""Blender frames per unit of scene time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .. import errors
from . import transforms

DEFAULT = 60.0  # frames per unit without a hint


def frames_per_unit(root: Path, header: dict[str, Any], entries: list[transforms.Entry]) -> float:
    """Return Blender frames per unit of time: from the file, from frame numbers, from duration and rate, or 60.

    Args:
        root: Folder of the data set, for messages.
        header: Values of the camera file.
        entries: Frames of all splits.

    Raises:
        DatasetError: A value of the file is not a positive number.
    """
    hints = {}
    for key in ("frames_per_unit", "fps", "duration"):
        if header.get(key) is not None:
            value = header[key]
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < float("inf"):
                raise errors.DatasetError(f"{root}: '{key}' must be a positive number, found {value!r}", code="D23")
            hints[key] = float(value)
    if "frames_per_unit" in hints:
        return hints["frames_per_unit"]
    numbered = [(entry.t, entry.frame) for entry in entries if entry.frame is not None]
    if len(numbered) == len(entries):
        t, frame = np.array(numbered).T
        if np.ptp(t) > 0 and np.ptp(frame) > 0:
            slope = float(np.polyfit(t, frame, 1)[0])
            if slope > 0:
                return slope
    if "fps" in hints and "duration" in hints:
        return hints["fps"] * hints["duration"]
    if "fps" in hints and max(entry.t for entry in entries) > 1.0:
        return hints["fps"]  # times are in seconds
    return DEFAULT
