"""caliscope's ``camera_array.toml``.

Poses are world to camera with OpenCV axes; the unit is the metre. ``rotation`` is a matrix in old versions and a
rotation vector in new ones. Lenses are ``matrix`` and ``distortions`` (k1 k2 p1 p2 k3; k1 to k4 with ``fisheye``), with
the first pixel's centre at 0. Cameras that are ignored or have no pose are left out.
"""

from __future__ import annotations

from pathlib import Path

from .... import errors
from ..calibration import CalibratedCamera, Calibration
from . import numbers

FILES = "camera_array.toml"


def detect(path: Path) -> Path | None:
    """Return the calibration file of a path, or None."""
    path = path / FILES if path.is_dir() else path
    return path if path.name == FILES and path.is_file() else None


def read(path: Path) -> Calibration:
    """Read the cameras. Raises DatasetError if the file is damaged."""
    tables = numbers.toml(path).get("cameras")
    if not isinstance(tables, dict):
        raise errors.DatasetError(f"{path}: expected the table 'cameras'; is it caliscope's file?")
    cameras = []
    for key, table in tables.items():
        place = f"{path}: camera {key}"
        if not isinstance(table, dict):
            raise errors.DatasetError(f"{place}: expected a table, found {table!r}")
        if table.get("ignore") or "rotation" not in table or "translation" not in table or "matrix" not in table:
            continue
        rotation = numbers.array(place, table, "rotation", (3, 3), (3,))
        shift = numbers.array(place, table, "translation", (3,))
        fisheye = bool(table.get("fisheye"))
        coefficients = numbers.array(place, table, "distortions", (-1,))
        lens = numbers.opencv_lens(place, numbers.array(place, table, "matrix", (3, 3)), coefficients, fisheye=fisheye)
        pose = numbers.pose_of_world_to_camera(place, rotation, shift)
        cameras.append(CalibratedCamera(f"cam_{key}", *numbers.size(place, table), lens, pose))
    numbers.unique(path, (camera.name for camera in cameras))
    return Calibration(tuple(cameras), 1.0, "caliscope", path, world_convention="blender")
