"""``train_meta.json`` and ``test_meta.json`` of Dynamic 3D Gaussians, for Panoptic Sports.

Per time and camera: ``k``, a camera matrix [3, 3], ``w2c``, world to camera with OpenCV axes [4, 4], ``cam_id``, and
``fn``, an image in `ims/`; ``w`` and ``h`` are the size of all images. Images are undistorted, and the image's centre
is half its size, so that the first pixel's centre is at 0.5. The unit is the metre, and times are frames of 30 Hz. If
all matrices mirror, the world is left-handed, and its x is negated. `init_pt_cld.npz` has points and colours.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from .... import errors, strict_json
from ..calibration import Calibration
from ..lens import Lens
from . import numbers, shots
from .shots import Shot

FILES = "train_meta.json"
_SPLITS = {FILES: "train", "test_meta.json": "test"}
_SECONDS_PER_TIME = 1 / 30


def detect(path: Path) -> Path | None:
    """Return the file of the training cameras of a path, or None."""
    path = path / FILES if path.is_dir() else path
    return path if path.name == FILES and path.is_file() else None


def read(path: Path) -> Calibration:
    """Read the cameras and images. Raises DatasetError if a file is damaged."""
    found = []
    mirror: np.ndarray | None = None  # signs of the world's axes, the same in all files
    for name, split in _SPLITS.items():
        file = path.with_name(name)
        if file.is_file():
            content = strict_json.read(file, errors.DatasetError)
            if not isinstance(content, dict):
                raise errors.DatasetError(f"{file}: expected a JSON object, found {type(content).__name__}")
            mirror = _mirror(content) if mirror is None else mirror
            found += _shots(file, content, split, mirror)
    cameras = shots.cameras(found)
    numbers.unique(path, (camera.name for camera in cameras))
    points, colors = _points(path.with_name("init_pt_cld.npz"))
    if points is not None and mirror is not None:
        points = points * mirror
    return Calibration(
        cameras,
        1.0,
        "panoptic",
        path,
        seconds_per_time=_SECONDS_PER_TIME,
        points=points,
        colors=colors,
    )


def _mirror(content: dict[str, Any]) -> np.ndarray:
    """Return the signs of the world's axes that make the first pose a rotation. [3]"""
    try:
        rotation = np.array(content["w2c"][0][0], np.float64)[:3, :3]
        return np.array([-1.0, 1.0, 1.0]) if np.linalg.det(rotation) < 0 else np.ones(3)
    except (KeyError, IndexError, TypeError, ValueError):
        return np.ones(3)  # the fault is reported where the pose is read


def _shots(path: Path, content: dict[str, Any], split: str, mirror: np.ndarray) -> list[Shot]:
    width, height = (numbers.side(str(path), numbers.number(str(path), content, key)) for key in ("w", "h"))
    names = _rows(path, content, "fn")
    columns = [_rows(path, content, key) for key in ("k", "w2c", "cam_id")]
    found = []
    for t, files in enumerate(names):
        rows = [column[t] if t < len(column) else None for column in columns]
        if not isinstance(files, list) or not all(isinstance(row, list) and len(row) == len(files) for row in rows):
            raise errors.DatasetError(f"{path}: time {t}: expected as many 'k', 'w2c' and 'cam_id' as images 'fn'")
        for index, file in enumerate(files):
            k, w2c, camera = (row[index] for row in rows if row)
            place = f"{path}: time {t}, camera {camera}"
            if not isinstance(file, str) or not isinstance(camera, int | str):
                raise errors.DatasetError(f"{place}: expected the name of an image, found {file!r}")
            matrix = numbers.array(place, {"w2c": w2c}, "w2c", (4, 4))
            pose = numbers.pose_of_world_to_camera(place, matrix[:3, :3] * mirror, matrix[:3, 3])
            lens = _lens(place, numbers.array(place, {"k": k}, "k", (3, 3)))
            found.append(Shot(str(camera), path.parent / "ims" / file, float(t), (width, height), lens, pose, split))
    return found


def _rows(path: Path, content: dict[str, Any], key: str) -> list:
    value = content.get(key)
    if not isinstance(value, list):
        raise errors.DatasetError(f"{path}: {key!r}: expected one list per time, found {type(value).__name__}")
    return value


def _lens(place: str, k: np.ndarray) -> Lens:
    try:
        return Lens("pinhole", float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
    except ValueError as error:
        raise errors.DatasetError(f"{place}: {error}") from error


def _points(path: Path) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
    """Return points [P, 3] and colours [P, 3] of a reconstruction, or None without the file."""
    if not path.is_file():
        return None, None
    try:
        with np.load(path, allow_pickle=False) as archive:
            table = np.asarray(archive["data"], np.float64)
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise errors.DatasetError(f"{path}: damaged, no archive with 'data' ({error}); copy it again") from error
    if table.ndim != 2 or table.shape[1] < 6:
        raise errors.DatasetError(f"{path}: 'data': expected rows of position and colour, found shape {table.shape}")
    table = table[np.isfinite(table).all(1)]
    return table[:, :3], table[:, 3:6].astype(np.float32)
