"""Reader of ``cameras.json`` of 3DGS and its descendants: one entry per image, camera to world, OpenCV axes."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import strict_json
from ..errors import CheckpointError
from ..scene import cameras
from ..scene.cameras import Camera

_log = logging.getLogger(__name__)
_TOLERANCE = 1e-3  # for R^T R - I of rotation matrices


def read(path: Path) -> tuple[Camera, ...]:
    """Read the distinct cameras of the file, by first appearance; returns () if the file is missing.

    Raises:
        CheckpointError: The file is damaged, or an entry is not a valid camera.
    """
    if not path.exists():
        return ()
    entries = strict_json.read(path, CheckpointError, "move the file away to import without cameras")
    if not isinstance(entries, list):
        raise CheckpointError(f"{path}: expected a list of cameras, found {type(entries).__name__}")
    found: dict[tuple, Camera] = {}
    for i, entry in enumerate(entries):
        camera = _camera(entry, f"{path}: camera {i}")
        numbers = np.concatenate([camera.intrinsics.ravel(), camera.T_cam_world.ravel()])
        key = (camera.width, camera.height, (np.round(numbers, 6) + 0.0).tobytes())
        if key not in found:
            taken = {other.name for other in found.values()}
            found[key] = camera if camera.name not in taken else replace(camera, name=f"{camera.name}@{i}")
    return tuple(found.values())


def _camera(entry: Any, place: str) -> Camera:
    try:
        width, height = int(entry["width"]), int(entry["height"])
        fx, fy = float(entry["fx"]), float(entry["fy"])
        center = np.array(entry["position"], np.float64).reshape(3)
        turn = np.array(entry["rotation"], np.float64).reshape(3, 3)
        name = str(entry.get("img_name", entry.get("id", "")))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(
            f"{place}: expected 'width', 'height', 'position', 'rotation', 'fx' and 'fy' ({type(error).__name__}: "
            f"{error}); move the file away to import without cameras"
        ) from error
    numbers = np.concatenate([center, turn.ravel(), [fx, fy]])
    rigid = np.isfinite(numbers).all() and np.abs(turn.T @ turn - np.eye(3)).max() < _TOLERANCE
    if not rigid or np.linalg.det(turn) < 0 or min(fx, fy, width, height) <= 0:
        raise CheckpointError(f"{place}: expected a rotation, a position and positive sizes, found other numbers")
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3], T_cam_world[:3, 3] = turn.T, -turn.T @ center
    intrinsics = np.array([[fx, 0.0, 0.5 * width], [0.0, fy, 0.5 * height], [0.0, 0.0, 1.0]])
    camera = Camera(width, height, intrinsics, T_cam_world, name)
    try:
        cameras.check(camera)
    except ValueError as error:
        raise CheckpointError(f"{place}: {error}") from error
    return camera
