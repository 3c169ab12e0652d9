"""Data sets of Nerfies and HyperNeRF: ``camera/ITEM.json`` for each image ``rgb/SCALEx/ITEM.png``.

``orientation`` is the rotation from world to camera with OpenCV axes, ``position`` the centre. The lens is
``focal_length``, ``pixel_aspect_ratio`` (fy / fx), ``principal_point`` with the first pixel's centre at 0.5, ``skew``
in pixels, ``radial_distortion`` k1 k2 k3 and ``tangential_distortion`` (or ``tangential``) p1 p2, as in OpenCV.
`metadata.json` has ``camera_id`` and ``time_id`` (or ``warp_id``), `dataset.json` the splits. The unit of the world is
free.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from .... import errors, strict_json
from ....data import array_file, images
from ..calibration import Calibration
from ..lens import Lens
from . import numbers, shots
from .shots import Shot

FILES = "camera/*.json with dataset.json"


def detect(path: Path) -> Path | None:
    """Return the folder of the data set at a path, or None."""
    path = path.parent if path.name == "camera" else path
    return path if (path / "dataset.json").is_file() and (path / "camera").is_dir() else None


def read(path: Path) -> Calibration:
    """Read the cameras of all images of `dataset.json`. Raises DatasetError if a file is damaged."""
    listing = _object(path / "dataset.json")
    metadata = _object(path / "metadata.json") if (path / "metadata.json").is_file() else {}
    splits = {str(item): "val" for item in _list(path, listing, "val_ids")}
    splits |= {str(item): "train" for item in _list(path, listing, "train_ids")}
    found = []
    for item in map(str, _list(path, listing, "ids") or sorted(splits)):
        file = path / "camera" / f"{item}.json"
        about = metadata.get(item, {})
        if not isinstance(about, dict):
            raise errors.DatasetError(f"{path / 'metadata.json'}: {item}: expected an object, found {about!r}")
        number = about.get("time_id", about.get("warp_id"))
        t = None if number is None else numbers.number(str(path / "metadata.json"), {item: number}, item)
        camera = f"cam_{about.get('camera_id', 0)}"
        found.append(_shot(file, camera, _image(path, item), t, splits.get(item, "")))
    cameras = shots.cameras(found)
    numbers.unique(path, (camera.name for camera in cameras))
    return Calibration(cameras, None, "nerfies", path, points=_points(path / "points.npy"))


def _shot(file: Path, camera: str, image: Path, t: float | None, split: str) -> Shot:
    content, place = _object(file), str(file)
    focal = numbers.number(place, content, "focal_length")
    aspect = numbers.number(place, content, "pixel_aspect_ratio", 1.0)
    cx, cy = numbers.array(place, content, "principal_point", (2,)).tolist()
    k1, k2, k3 = _optional(place, content, "radial_distortion", 3)
    key = "tangential" if "tangential" in content else "tangential_distortion"
    p1, p2 = _optional(place, content, key, 2)
    coefficients = (k1, k2, p1, p2, k3)
    try:
        model = ("brown", coefficients) if any(coefficients) else ("pinhole", ())
        lens = Lens(model[0], focal, focal * aspect, cx, cy, model[1], numbers.number(place, content, "skew", 0.0))
    except ValueError as error:
        raise errors.DatasetError(f"{file}: {error}") from error
    orientation = numbers.array(place, content, "orientation", (3, 3))
    center = numbers.array(place, content, "position", (3,))
    pose = numbers.pose_of_center(place, orientation.T, center)
    return Shot(camera, image, t, numbers.size(place, content, "image_size"), lens, pose, split)


def _image(path: Path, item: str) -> Path:
    """Return the largest image of an item: that of the smallest scale."""
    folders = path.glob("rgb/*x")
    scales = sorted(
        (int(match[1]), folder) for folder in folders if (match := re.fullmatch(r"(\d{1,4})x", folder.name))
    )
    for _, folder in scales:
        for suffix in images.SUFFIXES:
            if (folder / f"{item}{suffix}").is_file():
                return folder / f"{item}{suffix}"
    return path / "rgb" / "1x" / f"{item}.png"


def _object(file: Path) -> dict[str, Any]:
    content = strict_json.read(file, errors.DatasetError)
    if not isinstance(content, dict):
        raise errors.DatasetError(f"{file}: expected a JSON object, found {type(content).__name__}")
    return content


def _list(path: Path, listing: dict[str, Any], key: str) -> list:
    value = listing.get(key, [])
    if not isinstance(value, list) or not all(isinstance(item, str | int) for item in value):
        raise errors.DatasetError(f"{path / 'dataset.json'}: {key!r}: expected a list of names, found {value!r:.60}")
    return value


def _optional(place: str, content: dict[str, Any], key: str, count: int) -> list[float]:
    return numbers.array(place, content, key, (count,)).tolist() if content.get(key) is not None else [0.0] * count


def _points(file: Path) -> np.ndarray | None:
    """Return the points of the background, or None if the file is missing or has none."""
    if not file.is_file():
        return None
    points = array_file.read(file, 3)
    return points[np.isfinite(points).all(1)]
