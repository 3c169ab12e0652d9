"""Scale and up direction of a reconstructed world, which images alone do not determine."""

from __future__ import annotations

import dataclasses

import numpy as np

from ... import errors
from ...motion import rotations
from ..calibration.calibration import Calibration

CAMERAS, PLANE, BOARD = "cameras", "plane", "board"
_TRIALS = 2000
_NEAR = 0.01  # distance to a plane, of the points' spread
_STEEPEST = 0.5  # cosine between the up of the cameras and the normal of a supporting plane
_SAME_WAY = np.cos(np.radians(4))  # cosine between the normals of a resting board


def with_distance(calibration: Calibration, first: str, second: str, meters: float) -> Calibration:
    """Set the scale by the distance between two fixed cameras.

    Raises:
        DatasetError: A camera is unknown, or both are at one place.
    """
    centers = {camera.name: camera.camera_to_world[:3, 3] for camera in calibration.cameras}
    for name in (first, second):
        if name not in centers:
            raise errors.DatasetError(f"distance: no camera {name!r}; the cameras are {', '.join(centers)}")
    units = float(np.linalg.norm(centers[first] - centers[second]))
    if units <= 0 or meters <= 0:
        raise errors.DatasetError(f"distance: expected a positive distance between {first!r} and {second!r}")
    return dataclasses.replace(calibration, meters_per_unit=meters / units)


def check_up(up: str) -> None:
    """Raise ConfigError if `upright` does not know an up direction."""
    if up not in (CAMERAS, PLANE, BOARD):
        _vector(up)


def upright(calibration: Calibration, up: str, boards: list[np.ndarray] | None = None) -> Calibration:
    """Turn the world so that z is up.

    Args:
        calibration: Cameras, with the points of the reconstruction for `PLANE`.
        up: `CAMERAS`, the mean up of all images; `PLANE`, the normal of the largest plane that is roughly
            perpendicular to it; `BOARD`, the normal of the board while it rests longest; or a vector "x,y,z" of the
            world.
        boards: Poses of the board, board to world, for `BOARD`. [4, 4] each

    Raises:
        DatasetError: There is no such plane or board.
        ConfigError: The vector is invalid.
    """
    level = _of_cameras(calibration)
    if up == CAMERAS:
        direction = level
    elif up == PLANE:
        direction = _of_plane(calibration, level)
    elif up == BOARD:
        direction = _of_board(boards or [], level)
    else:
        direction = _vector(up)
    return dataclasses.replace(
        calibration.moved(_turn(direction, np.array([0.0, 0.0, 1.0])), np.zeros(3), 1.0), world_convention="blender"
    )


def _of_cameras(calibration: Calibration) -> np.ndarray:
    poses = [frame.camera_to_world for camera in calibration.cameras for frame in camera.frames]
    poses += [camera.camera_to_world for camera in calibration.cameras if not camera.frames]
    mean = -np.mean([pose[:3, 1] for pose in poses], axis=0)
    length = np.linalg.norm(mean)
    return mean / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])


def _of_plane(calibration: Calibration, level: np.ndarray) -> np.ndarray:
    points = calibration.points
    if points is None or len(points) < 10:
        raise errors.DatasetError("--up plane: expected points of a reconstruction, found none; use --up cameras")
    spread = float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
    rng = np.random.default_rng(0)
    best, inside = 0, np.zeros(len(points), bool)
    for _ in range(_TRIALS):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-12 * spread**2 or abs(normal @ level) < _STEEPEST * length:
            continue
        near = np.abs((points - a) @ (normal / length)) < _NEAR * spread
        if near.sum() > best:
            best, inside = int(near.sum()), near
    if best < 10:
        raise errors.DatasetError("--up plane: no level plane among the points; use --up cameras, or a vector")
    normal = np.linalg.svd(points[inside] - points[inside].mean(0), full_matrices=False)[2][2]
    return normal if normal @ level > 0 else -normal


def _of_board(boards: list[np.ndarray], level: np.ndarray) -> np.ndarray:
    if not boards:
        raise errors.DatasetError("--up board: expected sightings of a board, found none; name the board with --board")
    normals = np.array([pose[:3, 2] for pose in boards])
    normals *= np.where(normals @ level < 0, -1.0, 1.0)[:, None]
    agree = normals @ normals.T > _SAME_WAY
    mean = normals[agree[agree.sum(1).argmax()]].mean(0)
    return mean / np.linalg.norm(mean)


def _vector(text: str) -> np.ndarray:
    try:
        vector = np.array([float(part) for part in text.split(",")])
    except ValueError:
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not vector.any():
        raise errors.ConfigError(f"--up {text}: expected cameras, plane, board, or a vector such as 0,-1,0")
    return vector / np.linalg.norm(vector)


def _turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the smallest rotation from one unit vector to another. [3, 3]"""
    axis, cosine = np.cross(start, end), float(start @ end)
    if cosine < -1 + 1e-12:  # opposite: half a turn about any normal axis
        normal = np.cross(start, np.eye(3)[np.abs(start).argmin()])
        normal /= np.linalg.norm(normal)
        return 2 * np.outer(normal, normal) - np.eye(3)
    cross = rotations.skew(axis)
    return np.eye(3) + cross + cross @ cross / (1 + cosine)
