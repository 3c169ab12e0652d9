"""``intri.yml`` and ``extri.yml`` of OpenCV's `FileStorage`, as EasyMocap and EasyVolcap write them.

For each of the ``names``: ``K_NAME`` and ``D_NAME`` (or ``dist_NAME``, k1 k2 p1 p2 k3) in `intri.yml`, with the first
pixel's centre at 0, and if known ``W_NAME``, ``H_NAME``; world to camera in `extri.yml`, with OpenCV axes: ``R_NAME``,
a rotation vector, or ``Rot_NAME``, a matrix, and ``T_NAME``. The unit is the metre.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from .... import errors
from ..calibration import CalibratedCamera, Calibration
from . import numbers

FILES = "intri.yml with extri.yml"
INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"
_ENTRY = re.compile(r"^([^\s#%:\-][^:\n]*):(.*(?:\n(?:[ \t-].*|[ \t]*(?=\n)))*)", re.MULTILINE)


def detect(path: Path) -> Path | None:
    """Return the file of the intrinsics of a path, or None."""
    folder = path if path.is_dir() else path.parent if path.name in (INTRINSICS, EXTRINSICS) else None
    if folder is None or not ((folder / INTRINSICS).is_file() and (folder / EXTRINSICS).is_file()):
        return None
    return folder / INTRINSICS


def read(path: Path) -> Calibration:
    """Read the cameras. Raises DatasetError if a file is damaged, or lacks a camera of the other."""
    extrinsics = path.with_name(EXTRINSICS)
    inner, outer = read_storage(path), read_storage(extrinsics)
    names = inner.get("names") or [key.removeprefix("K_") for key in inner if key.startswith("K_")]
    if not isinstance(names, list):
        raise errors.DatasetError(f"{path}: 'names': expected a list, found {names!r}")
    cameras = []
    for name in map(str, names):
        place = f"{path}: camera {name}"
        if f"rdist_{name}" in inner:
            raise errors.DatasetError(f"{place}: the lens model 'rdist' is not supported; undistort the images first")
        key = f"D_{name}" if f"D_{name}" in inner else f"dist_{name}"
        coefficients = numbers.array(place, inner, key, (-1, -1)).ravel() if key in inner else np.zeros(0)
        lens = numbers.opencv_lens(place, numbers.array(place, inner, f"K_{name}", (3, 3)), coefficients)
        size = [numbers.number(place, inner, f"{side}_{name}", 0.0) for side in "WH"]
        width, height = (numbers.side(place, side) for side in size) if all(size) else (0, 0)
        place = f"{extrinsics}: camera {name}"
        turn = f"R_{name}" if f"R_{name}" in outer else f"Rot_{name}"
        rotation = numbers.array(place, outer, turn, (3, 1), (1, 3), (3, 3))
        shift = numbers.array(place, outer, f"T_{name}", (3, 1), (1, 3)).ravel()
        pose = numbers.pose_of_world_to_camera(place, rotation, shift)
        cameras.append(CalibratedCamera(name, width, height, lens, pose))
    numbers.unique(path, (camera.name for camera in cameras))
    return Calibration(tuple(cameras), 1.0, "opencv_yaml", path, world_convention="blender")


def read_storage(path: Path) -> dict[str, Any]:
    """Read the matrices, lists and numbers at the top of a YAML file of OpenCV."""
    content = numbers.text(path).replace("\r\n", "\n")
    if not content.lstrip().startswith("%YAML"):
        raise errors.DatasetError(f"{path}: expected a file of OpenCV's FileStorage, which begins with '%YAML'")
    return {key.strip().strip('"'): _value(path, key, text.strip()) for key, text in _ENTRY.findall(content)}


def _value(path: Path, key: str, text: str) -> Any:
    if text.startswith("!!opencv-matrix"):
        rows, columns = (re.search(rf"\b{word}:\s*(\d{{1,6}})", text) for word in ("rows", "cols"))
        data = re.search(r"\bdata:\s*\[([^\]]*)\]", text)
        if rows is None or columns is None or data is None:
            raise errors.DatasetError(f"{path}: {key}: expected a matrix with rows, cols and data; is it truncated?")
        values = [_number(path, key, word) for word in data[1].replace(",", " ").split()]
        if len(values) != int(rows[1]) * int(columns[1]):
            raise errors.DatasetError(
                f"{path}: {key}: expected {rows[1]}x{columns[1]} numbers, found {len(values)}; is it truncated?"
            )
        return np.array(values).reshape(int(rows[1]), int(columns[1]))
    if re.fullmatch(r"[-+.\d][-+.\deE]*", text):
        return _number(path, key, text)
    if text.startswith(("-", "[")):
        return [quoted or plain for quoted, plain in re.findall(r'"([^"]*)"|([^\s,\[\]"-][^\s,\[\]"]*)', text)]
    return text.strip('"')


def _number(path: Path, key: str, word: str) -> float:
    try:
        return float(word)
    except ValueError as error:
        raise errors.DatasetError(f"{path}: {key}: expected a number, found {word[:40]!r}") from error
