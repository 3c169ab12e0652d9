"""nerfstudio's ``transforms.json``, also instant-ngp's, and ``transforms_{train,val,test}.json`` with distortion.

Poses are camera to world with OpenGL axes; the world is the one of the file, z up, whose unit is free. Lenses are
``fl_x fl_y cx cy w h`` with the first pixel's centre at 0.5, ``camera_model``, and ``k1 k2 k3 k4 p1 p2``. Perspective
lenses have the factor 1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8 in the tangent plane; FULL_OPENCV is OpenCV's rational
model with k1 to k6. OPENCV_FISHEYE (or ``is_fisheye``) has the same factor in the plane of angles. FISHEYE624 has
twelve ``distortion_params``; those of the other models are k1 k2 k3 k4 p1 p2.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .... import errors, strict_json
from ....data import images, transforms
from ....data.splits import SPLITS
from ....data.transforms import Entry
from ....scene import cameras as core_cameras
from ..calibration import Calibration
from ..lens import Lens
from . import numbers, shots
from .shots import Shot

FILES = "transforms.json"
_SPLITS = {FILES: "", "transforms_train.json": "train", "transforms_val.json": "val", "transforms_test.json": "test"}
_PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_RATIONAL, _FISHEYE, _FISHEYE624 = "FULL_OPENCV", "OPENCV_FISHEYE", "FISHEYE624"
_POLYNOMIAL = ("k1", "k2", "k3", "k4", "p1", "p2")


def detect(path: Path) -> Path | None:
    """Return the camera file of a path, or None."""
    if path.is_dir():
        return next((path / name for name in _SPLITS if (path / name).is_file()), None)
    return path if path.name in _SPLITS and path.is_file() else None


def read(path: Path) -> Calibration:
    """Read the cameras and images of a file, and of the other splits. Raises DatasetError if a file is damaged."""
    files = [path] if path.name == FILES else [path.with_name(name) for name in _SPLITS if name != FILES]
    found = [shot for file in files if file.is_file() for shot in _read_file(file)]
    cameras = shots.cameras(found)
    numbers.unique(path, (camera.name for camera in cameras))
    return Calibration(cameras, None, "nerfstudio", path, world_convention="blender")


def _read_file(path: Path) -> list[Shot]:
    content = strict_json.read(path, errors.DatasetError, finite=False)  # numbers are checked where they are used
    entries, header = transforms.parse(path, content)
    groups = [content] if isinstance(content.get("frames"), list) else content["data"].values()
    frames = [frame for group in groups for frame in group["frames"]]
    splits = {}
    for split in SPLITS:
        listed = header.get(f"{split}_filenames", [])
        splits |= {name: split for name in listed if isinstance(name, str)} if isinstance(listed, list) else {}
    found = []
    for entry, frame in zip(entries, frames, strict=True):
        image = _image(path.parent, entry.file_path)
        size = _size(entry, image)
        lens = _lens(entry, size, {**header, **frame})
        pose = np.linalg.inv(core_cameras.opengl_to_cam_world(entry.matrix))
        t = entry.t if "time" in frame else None
        split = splits.get(entry.file_path, _SPLITS[path.name])
        found.append(Shot(entry.camera, image, t, size, lens, pose, split))
    return found


def _image(root: Path, name: str) -> Path:
    """Return the image of a path in a camera file, which may lack the suffix."""
    path = root / name.replace("\\", "/")
    if path.suffix.lower() in images.SUFFIXES:
        return path
    candidates = (path.with_name(path.name + suffix) for suffix in images.SUFFIXES)
    return next((candidate for candidate in candidates if candidate.is_file()), path)


def _size(entry: Entry, image: Path) -> tuple[int, int]:
    if "w" in entry.lens and "h" in entry.lens:
        return numbers.side(entry.place, entry.lens["w"]), numbers.side(entry.place, entry.lens["h"])
    width, height, _ = images.size(image)
    return width, height


def _lens(entry: Entry, size: tuple[int, int], fields: dict[str, Any]) -> Lens:
    """Return the lens of a frame. ``fields`` are the keys of the frame and those of the file."""
    place = entry.lens_place or entry.place
    fisheye = bool(fields.get("is_fisheye"))
    model = fields.get("camera_model", _FISHEYE if fisheye else "OPENCV")
    if model not in (*_PERSPECTIVE, _RATIONAL, _FISHEYE, _FISHEYE624):
        raise errors.DatasetError(
            f"{place}: the camera model {model!r} is not supported. Remedy: render perspective views of its images, "
            "for panoramas with 'ns-process-data images --camera-type equirectangular'"
        )
    name, coefficients = _distortion(place, str(model), entry.lens, fields.get("distortion_params"))
    matrix = transforms.intrinsics(entry, *size)
    try:
        return Lens(
            name, matrix[0, 0].item(), matrix[1, 1].item(), matrix[0, 2].item(), matrix[1, 2].item(), coefficients
        )
    except ValueError as error:
        raise errors.DatasetError(f"{place}: {error}") from error


def _distortion(place: str, model: str, lens: dict[str, float], listed: Any) -> tuple[str, tuple[float, ...]]:
    """Return the model of `distortion` and its coefficients."""
    if model == _FISHEYE624:
        table = {"distortion_params": listed}
        return "project_aria", tuple(numbers.array(place, table, "distortion_params", (12,)).tolist())
    if listed is not None:
        values = numbers.array(place, {"distortion_params": listed}, "distortion_params", (6,)).tolist()
        lens = dict(zip(_POLYNOMIAL, values, strict=True))
    k1, k2, k3, k4, p1, p2 = (lens.get(key, 0.0) for key in _POLYNOMIAL)
    k5, k6 = lens.get("k5", 0.0), lens.get("k6", 0.0)
    if model == _RATIONAL:
        return "brown", (k1, k2, p1, p2, k3, k4, k5, k6)
    if k5 or k6:
        raise errors.DatasetError(f"{place}: k5 and k6 need the camera_model {_RATIONAL}, found {model}")
    if model == _FISHEYE:
        return ("thin_prism_fisheye", (k1, k2, p1, p2, k3, k4, 0.0, 0.0)) if p1 or p2 else ("fisheye", (k1, k2, k3, k4))
    if k4:
        return "thin_prism", (k1, k2, p1, p2, k3, k4, 0.0, 0.0)
    return ("brown", (k1, k2, p1, p2, k3)) if any((k1, k2, p1, p2, k3)) else ("pinhole", ())
