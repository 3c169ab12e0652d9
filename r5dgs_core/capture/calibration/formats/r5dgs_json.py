"""``r5dgs_cameras.json``, in which `r5dgs prepare` keeps cameras that it reconstructed.

``cameras`` lists name, size, lens (`Lens`, with the first pixel's centre at 0.5), ``camera_to_world`` with OpenCV axes,
and the ``frames`` of a moving camera with path, time in seconds, lens and pose. ``points`` are those of the
reconstruction, rows of x, y, z in the world and red, green, blue in [0, 1]. ``recordings`` has a fingerprint of the
recordings of each camera, by which `r5dgs prepare` notices that the cameras are those of other recordings.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .... import atomic_files, errors, strict_json
from ..calibration import CalibratedCamera, CalibratedFrame, Calibration
from ..lens import Lens
from . import numbers

FILES = "r5dgs_cameras.json"
_VERSION = 1


def detect(path: Path) -> Path | None:
    """Return the file of a path, or None."""
    path = path / FILES if path.is_dir() else path
    return path if path.name == FILES and path.is_file() else None


def write(path: Path, calibration: Calibration, recordings: Mapping[str, str] | None = None) -> None:
    """Write cameras, the points of the reconstruction, and fingerprints of the recordings by camera."""
    points: list[list[float]] = []
    if calibration.points is not None and calibration.colors is not None:
        points = np.round(np.concatenate([calibration.points, calibration.colors], axis=1), 6).tolist()
    content = {
        "format_version": _VERSION,
        "meters_per_unit": calibration.meters_per_unit,
        "world_convention": calibration.world_convention,
        "cameras": [
            {
                "name": camera.name,
                "size": [camera.width, camera.height],
                "lens": dataclasses.asdict(camera.lens),
                "camera_to_world": camera.camera_to_world.tolist(),
                "frames": [
                    {
                        "path": str(frame.path),
                        "time": frame.time,
                        "lens": dataclasses.asdict(frame.lens),
                        "camera_to_world": frame.camera_to_world.tolist(),
                    }
                    for frame in camera.frames
                ],
            }
            for camera in calibration.cameras
        ],
        "points": points,
        "recordings": dict(recordings or {}),
    }
    with atomic_files.replacing_by_name(path) as temporary:
        Path(temporary).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_recordings(path: Path) -> dict[str, str]:
    """Return the fingerprints of the recordings by camera; empty if the file has none.

    Raises:
        DatasetError: The file is damaged.
    """
    content = strict_json.read(path, errors.DatasetError)
    found = content.get("recordings") if isinstance(content, dict) else None
    return found if isinstance(found, dict) else {}


def read(path: Path) -> Calibration:
    """Read cameras. Raises DatasetError if the file is damaged or of another version."""
    content = strict_json.read(path, errors.DatasetError)
    if not isinstance(content, dict) or content.get("format_version") != _VERSION:
        raise errors.DatasetError(f"{path}: expected format_version {_VERSION}; prepare the data set again")
    listed = content.get("cameras")
    if not isinstance(listed, list):
        raise errors.DatasetError(f"{path}: 'cameras': expected a list; prepare the data set again")
    cameras = tuple(_camera(f"{path}: camera {index}", table) for index, table in enumerate(listed))
    numbers.unique(path, (camera.name for camera in cameras))
    unit = content.get("meters_per_unit")
    unit = None if unit is None else numbers.number(str(path), content, "meters_per_unit")
    convention = content.get("world_convention")
    if convention not in ("blender", "colmap", "opengl"):
        raise errors.DatasetError(
            f"{path}: 'world_convention': expected blender, colmap or opengl, found {convention!r}"
        )
    points = colors = None
    if content.get("points"):
        table = numbers.array(str(path), content, "points", (-1, 6))
        points, colors = table[:, :3], table[:, 3:].astype(np.float32)
    return Calibration(cameras, unit, "r5dgs_json", path, convention, 1.0, points, colors)


def _camera(place: str, table: Any) -> CalibratedCamera:
    if not isinstance(table, dict) or not isinstance(table.get("name"), str) or not table["name"]:
        raise errors.DatasetError(f"{place}: expected an object with a 'name'; prepare the data set again")
    frames, listed = [], table.get("frames", [])
    if not isinstance(listed, list):
        raise errors.DatasetError(f"{place}: 'frames': expected a list; prepare the data set again")
    for index, frame in enumerate(listed):
        at = f"{place}, frame {index}"
        if not isinstance(frame, dict) or not isinstance(frame.get("path"), str):
            raise errors.DatasetError(f"{at}: expected an object with a 'path'; prepare the data set again")
        time = None if frame.get("time") is None else numbers.number(at, frame, "time")
        frames.append(CalibratedFrame(Path(frame["path"]), time, _lens(at, frame), _pose(at, frame)))
    size = numbers.size(place, table)
    return CalibratedCamera(table["name"], *size, _lens(place, table), _pose(place, table), tuple(frames))


def _pose(place: str, table: dict[str, Any]):
    matrix = numbers.array(place, table, "camera_to_world", (4, 4))
    return numbers.pose_of_center(place, matrix[:3, :3], matrix[:3, 3])


def _lens(place: str, table: dict[str, Any]) -> Lens:
    lens = table.get("lens")
    if not isinstance(lens, dict):
        raise errors.DatasetError(f"{place}: 'lens': expected an object; prepare the data set again")
    fx, fy, cx, cy = (numbers.number(place, lens, key) for key in ("fx", "fy", "cx", "cy"))
    coefficients = tuple(numbers.array(place, lens, "coefficients", (-1,)).tolist())
    try:
        return Lens(str(lens.get("model")), fx, fy, cx, cy, coefficients, numbers.number(place, lens, "skew", 0.0))
    except ValueError as error:
        raise errors.DatasetError(f"{place}: {error}; prepare the data set again") from error
