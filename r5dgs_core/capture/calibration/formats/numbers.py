"""Numbers, matrices and poses in calibration files, with errors that name their place."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from .... import errors
from ....motion import rotations
from ....scene import cameras
from ..lens import Lens

MAX_BYTES = 16 << 20  # per TOML, XML or YAML file
RIGID_TOLERANCE = 1e-3  # of the entries of R R^T - 1
LONGEST_ROTATION = 1e3  # of a rotation vector, rad


def text(path: Path) -> str:
    """Read a text file. Raises DatasetError if it cannot be read or is larger than `MAX_BYTES`."""
    try:
        with open(path, "rb") as stream:
            data = stream.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise errors.DatasetError(f"{path}: expected a file of at most {MAX_BYTES >> 20} MiB; is it a calibration?")
        return data.decode("utf-8-sig")
    except FileNotFoundError as error:
        raise errors.DatasetError(f"{path}: the file is missing") from error
    except (OSError, UnicodeDecodeError) as error:
        raise errors.DatasetError(f"{path}: cannot be read ({error}); export the calibration again") from error


def toml(path: Path) -> dict[str, Any]:
    """Read a TOML file."""
    try:
        return tomllib.loads(text(path))
    except (ValueError, RecursionError) as error:  # also for whole numbers of too many digits
        raise errors.DatasetError(f"{path}: damaged, not valid TOML: {error}; export the calibration again") from error


def array(place: str, table: dict, key: str, *shapes: tuple[int, ...]) -> np.ndarray:
    """Return an array of finite numbers of one of the shapes, where -1 stands for any length."""
    try:
        value = np.array(table[key], np.float64)
    except KeyError:
        raise errors.DatasetError(f"{place}: {key!r} is missing; export the calibration again") from None
    except (TypeError, ValueError) as error:
        raise errors.DatasetError(f"{place}: {key!r}: expected numbers, found {str(table[key])[:60]}") from error
    for shape in shapes:
        if value.ndim == len(shape) and all(n in (-1, m) for n, m in zip(shape, value.shape, strict=True)):
            if not np.isfinite(value).all():
                raise errors.DatasetError(f"{place}: {key!r}: expected finite numbers, found {value.tolist()}")
            return value
    wanted = " or ".join("x".join("n" if n < 0 else str(n) for n in shape) for shape in shapes)
    raise errors.DatasetError(f"{place}: {key!r}: expected {wanted} numbers, found shape {value.shape}")


def number(place: str, table: dict, key: str, default: float | None = None) -> float:
    """Return a finite number; the default if it is missing, else DatasetError."""
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise errors.DatasetError(f"{place}: {key!r}: expected a finite number, found {value!r}")
    return float(value)


def size(place: str, table: dict, key: str = "size") -> tuple[int, int]:
    """Return an image size, width and height in pixels."""
    width, height = array(place, table, key, (2,)).tolist()
    return side(place, width), side(place, height)


def side(place: str, value: float) -> int:
    """Return a side of an image in whole pixels."""
    if not (1 <= value <= 1 << 16 and value == int(value)):
        raise errors.DatasetError(f"{place}: expected an image size in whole pixels, found {value:g}")
    return int(value)


def pose_of_world_to_camera(place: str, rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return the camera-to-world matrix of a transform from world to camera, OpenCV axes.

    Args:
        place: File and camera, for errors.
        rotation: Rotation matrix [3, 3], or rotation vector, axis times angle in rad [3].
        shift: Translation. [3]
    """
    matrix = rotation_matrix(place, rotation)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = matrix.T, -matrix.T @ _near(place, shift)
    return pose


def pose_of_center(place: str, axes: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Return the camera-to-world matrix of a rotation from camera to world, OpenCV axes [3, 3], and a centre [3]."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_matrix(place, axes), _near(place, center)
    return pose


def _near(place: str, position: np.ndarray) -> np.ndarray:
    """Return a position after a check of its magnitude. [3]"""
    if not np.abs(position).max() <= cameras.FARTHEST:
        raise errors.DatasetError(
            f"{place}: expected a position within {cameras.FARTHEST:g} units, found {position.tolist()!s:.80}; "
            "calibrate again"
        )
    return position


def rotation_matrix(place: str, rotation: np.ndarray) -> np.ndarray:
    """Return the rotation matrix that is nearest to a matrix [3, 3], or that of a rotation vector [3].

    Raises:
        DatasetError: The matrix or vector is no rotation.
    """
    if rotation.size == 3:
        if not np.abs(rotation).max() <= LONGEST_ROTATION:
            raise errors.DatasetError(
                f"{place}: expected a rotation vector in radians, found {rotation.tolist()!s:.80}; calibrate again"
            )
        return rotations.quats_to_rotmats(rotations.rotvecs_to_quats(rotation.reshape(3)))
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not off < RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        raise errors.DatasetError(
            f"{place}: expected a rotation matrix, found one that is off by {off:.2g} or mirrors; calibrate again"
        )
    u, _, v = np.linalg.svd(rotation)
    return u @ v


def opencv_lens(place: str, matrix: np.ndarray, coefficients: Iterable[float], *, fisheye: bool = False) -> Lens:
    """Return the lens of a camera matrix and OpenCV's coefficients. Raises DatasetError if they are invalid."""
    try:
        return Lens.from_opencv(matrix, tuple(coefficients), fisheye=fisheye)
    except ValueError as error:
        raise errors.DatasetError(f"{place}: {error}; export the calibration again") from error


def unique(path: Path, names: Iterable[str]) -> None:
    """Raise DatasetError if there is no name, or two are equal apart from case."""
    seen: set[str] = set()
    for name in names:
        if name.lower() in seen:
            raise errors.DatasetError(f"{path}: two cameras are named {name!r}; rename one")
        seen.add(name.lower())
    if not seen:
        raise errors.DatasetError(f"{path}: expected calibrated cameras, found none; finish the calibration first")
