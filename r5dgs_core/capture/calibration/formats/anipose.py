"""anipose's ``calibration.toml``, also written by aniposelib and sleap-anipose.

One table per camera, named by its ``name`` or else by the table. Poses are world to camera with OpenCV axes,
``rotation`` is a rotation vector, and the unit is that of the calibration board. Lenses are ``matrix`` and
``distortions`` (k1 k2 p1 p2 k3; k1 to k4 with ``fisheye``), with the first pixel's centre at 0.
"""

from __future__ import annotations

from pathlib import Path

from .... import errors
from ..calibration import CalibratedCamera, Calibration
from . import numbers

FILES = "calibration.toml"


def detect(path: Path) -> Path | None:
    """Return the calibration file of a path, or None; any TOML file with tables of cameras is accepted by its path."""
    if path.is_dir():
        return path / FILES if (path / FILES).is_file() else None
    return path if path.suffix.lower() == ".toml" and path.is_file() else None


def read(path: Path) -> Calibration:
    """Read the cameras. Raises DatasetError if the file is damaged."""
    return Calibration(read_cameras(path), None, "anipose", path)


def read_cameras(path: Path) -> tuple[CalibratedCamera, ...]:
    """Read the tables of cameras of a file in this layout."""
    cameras = []
    for key, table in numbers.toml(path).items():
        if not isinstance(table, dict) or "matrix" not in table:
            continue  # metadata
        place = f"{path}: camera {key}"
        name = table.get("name", key)
        if not isinstance(name, str | int) or not str(name):
            raise errors.DatasetError(f"{place}: expected a 'name', found {name!r}")
        rotation = numbers.array(place, table, "rotation", (3,), (3, 3))
        shift = numbers.array(place, table, "translation", (3,))
        fisheye = bool(table.get("fisheye"))
        coefficients = numbers.array(place, table, "distortions", (-1,))
        lens = numbers.opencv_lens(place, numbers.array(place, table, "matrix", (3, 3)), coefficients, fisheye=fisheye)
        pose = numbers.pose_of_world_to_camera(place, rotation, shift)
        cameras.append(CalibratedCamera(str(name), *numbers.size(place, table), lens, pose))
    numbers.unique(path, (camera.name for camera in cameras))
    return tuple(cameras)
