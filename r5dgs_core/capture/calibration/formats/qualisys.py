"""Qualisys' ``*.qca.txt``, an XML file.

Each camera has a ``transform`` with its centre ``x y z`` in millimetres and its axes as rows ``r11 r12 r13``, ... in
the world; its second and third axis point up and backwards. ``intrinsic`` has focal lengths and principal point in 1/64
of a pixel, with the first pixel's centre at 0, and OpenCV's distortion, which is not in this unit. ``fov_video`` is the
part of the sensor that the video shows, its last row and column included. The world's z is up.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from .... import errors
from ..calibration import CalibratedCamera, Calibration
from . import numbers

FILES = "*.qca.txt"
_UNITS_PER_PIXEL = 64
_METERS_PER_UNIT = 1e-3


def detect(path: Path) -> Path | None:
    """Return the calibration file of a path, or None; in a folder, the only file ``*.qca.txt``."""
    if path.is_dir():
        found = sorted(file for file in path.glob(FILES) if file.is_file())
        return found[0] if len(found) == 1 else None
    return path if path.name.lower().endswith(".qca.txt") and path.is_file() else None


def read(path: Path) -> Calibration:
    """Read the active cameras. Raises DatasetError if the file is damaged."""
    content = numbers.text(path)
    if "<!DOCTYPE" in content or "<!ENTITY" in content:
        raise errors.DatasetError(f"{path}: expected XML without a document type; export the calibration again")
    try:
        root = ElementTree.fromstring(content)
    except ElementTree.ParseError as error:
        raise errors.DatasetError(f"{path}: damaged, not valid XML: {error}; export the calibration again") from error
    cameras = []
    for index, node in enumerate(root.iter("camera"), 1):
        name = node.get("serial") or str(index)
        if node.get("active") != "0":
            cameras.append(_camera(f"{path}: camera {name}", name, node))
    numbers.unique(path, (camera.name for camera in cameras))
    return Calibration(tuple(cameras), _METERS_PER_UNIT, "qualisys", path, world_convention="blender")


def _camera(place: str, name: str, node: ElementTree.Element) -> CalibratedCamera:
    if node.get("viewrotation", "0") not in ("0", ""):
        raise errors.DatasetError(
            f"{place}: expected a view without rotation, found {node.get('viewrotation')} degrees; set the view "
            "rotation to 0, and export calibration and videos again"
        )
    pose, lens, view = (_numbers(place, node, tag) for tag in ("transform", "intrinsic", "fov_video"))

    def values(table: dict[str, float], *keys: str) -> list[float]:
        return [numbers.number(place, table, key) for key in keys]

    axes = np.array([values(pose, *(f"r{row}{column}" for column in (1, 2, 3))) for row in (1, 2, 3)])
    world_to_camera = np.diag([1.0, -1.0, -1.0]) @ numbers.rotation_matrix(place, axes)
    center = np.array(values(pose, "x", "y", "z"))
    left, top, right, bottom = values(view, "left", "top", "right", "bottom")
    units = values(lens, "focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
    fx, fy, cx, cy = (value / _UNITS_PER_PIXEL for value in units)
    matrix = np.array([[fx, numbers.number(place, lens, "skew", 0.0), cx - left], [0, fy, cy - top], [0, 0, 1]])
    coefficients = values(
        lens, "radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2"
    )
    coefficients.append(numbers.number(place, lens, "radialDistortion3", 0.0))
    size = numbers.side(place, right - left + 1), numbers.side(place, bottom - top + 1)
    camera_to_world = numbers.pose_of_center(place, world_to_camera.T, center)
    return CalibratedCamera(name, *size, numbers.opencv_lens(place, matrix, coefficients), camera_to_world)


def _numbers(place: str, node: ElementTree.Element, tag: str) -> dict[str, float]:
    """Return the attributes of a camera's element that are numbers."""
    found = node.find(tag)
    if found is None:
        raise errors.DatasetError(f"{place}: {tag!r} is missing; export the calibration again")
    table = {}
    for key, value in found.attrib.items():
        try:
            table[key] = float(value)
        except ValueError:
            continue  # its absence is reported if it is needed
    return table
