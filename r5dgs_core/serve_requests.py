"""What a request to the worker holds, checked: each function returns it, or raises a ConfigError that names it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from . import errors
from .scene.cameras import Camera

if TYPE_CHECKING:
    from .raster import scene_render


def need(request: dict[str, Any], key: str, kind: type | tuple[type, ...]) -> Any:
    """A value of some type."""
    value = request.get(key)
    if not isinstance(value, kind):
        raise errors.ConfigError(f"worker: '{request.get('command')}' needs '{key}', found {value!r}")
    return value


def stamp_of(path: Any) -> tuple[str, int, int]:
    """What tells a scene file from another, and from itself after a change."""
    if not isinstance(path, str):
        raise errors.ConfigError(f"worker: 'load' needs paths, found {path!r}")
    try:
        status = Path(path).stat()
    except OSError as error:
        raise errors.SceneFileError(
            f"{path}: expected a .r5dgs file, found none ({error.strerror}); choose its new place under "
            "'Scene File' in the R5DGS tab"
        ) from error
    return path, status.st_mtime_ns, status.st_size


def number_of(value: dict[str, Any], numbers: list[int]) -> int:
    """Which of the loaded scenes is meant by its place among the paths; the first one where nothing is said."""
    number = value.get("scene", 0)
    if not isinstance(number, int) or not 0 <= number < len(numbers):
        raise errors.ConfigError(f"worker: 'scene' has to be a number below {len(numbers)}, found {number!r}")
    return numbers[number]


def matrix_of(value: Any, size: int, what: str) -> np.ndarray:
    """A square matrix of finite numbers, float64."""
    try:
        matrix = np.asarray(value, np.float64).reshape(size, size)
    except (TypeError, ValueError):
        raise errors.ConfigError(f"worker: {what} has to hold {size} x {size} numbers") from None
    if not np.isfinite(matrix).all():
        raise errors.ConfigError(f"worker: {what} holds values that are not finite")
    return matrix


def camera_of(value: dict[str, Any]) -> Camera:
    """A camera."""
    width, height = value.get("width"), value.get("height")
    if not (isinstance(width, int) and isinstance(height, int) and 0 < width <= 32768 and 0 < height <= 32768):
        raise errors.ConfigError(f"worker: a camera needs width and height from 1 to 32768, found {width} x {height}")
    intrinsics = matrix_of(value.get("intrinsics"), 3, "the camera's intrinsics")
    return Camera(width, height, intrinsics, matrix_of(value.get("T_cam_world"), 4, "the camera's T_cam_world"))


def instance_of(value: dict[str, Any], numbers: list[int]) -> scene_render.Instance:
    """An entry of ``instances``."""
    from .raster import scene_render  # late: it needs torch

    try:
        start, count = int(value["start"]), int(value["count"])
    except (KeyError, TypeError, ValueError):
        raise errors.ConfigError(f"worker: an instance needs start, count and matrix, found {value!r}") from None
    world = value.get("world")
    if world is not None:
        world = matrix_of(world, 4, f"the world of rows {start}")
    matrix = matrix_of(value.get("matrix"), 4, f"the matrix of rows {start}")
    t = value.get("t")
    if t is not None and not (isinstance(t, int | float) and math.isfinite(t)):
        raise errors.ConfigError(f"worker: the time of an instance has to be a number, found {t!r}")
    return scene_render.Instance(start, count, matrix, number_of(value, numbers), world, _tint_of(value), t)


def _tint_of(value: dict[str, Any]) -> tuple[float, float, float] | None:
    tint = value.get("tint")
    if tint is None:
        return None
    if not (isinstance(tint, list) and len(tint) == 3 and all(isinstance(factor, int | float) for factor in tint)):
        raise errors.ConfigError(f"worker: a tint has to hold three factors, found {tint!r}")
    red, green, blue = map(float, tint)
    return red, green, blue


def distance_of(request: dict[str, Any]) -> float:
    """From which depth on depths count."""
    distance = request.get("distance", 0.0)
    if not (isinstance(distance, int | float) and math.isfinite(distance)):
        raise errors.ConfigError(f"worker: 'distance' has to be a number, found {distance!r}")
    return float(distance)


def near_of(request: dict[str, Any]) -> float | None:
    """Nearest depth that is drawn; None for the scenes' own."""
    near = request.get("near")
    if near is not None and not (isinstance(near, int | float) and near > 0):
        raise errors.ConfigError(f"worker: 'near' has to be a depth > 0, found {near!r}")
    return near


def wanted(request: dict[str, Any], known: tuple[str, ...]) -> list[str]:
    """Names of the arrays that are asked for."""
    want = request.get("want", [])
    unknown = set(want) - set(known)
    if unknown:
        raise errors.ConfigError(f"worker: cannot render {sorted(unknown)}; known are {', '.join(known)}")
    return want


def coverage_of(request: dict[str, Any]) -> tuple[list[int], int]:
    """The group of each instance, and how many of them each pixel keeps."""
    asked, count = request["coverage"], len(request["instances"])
    groups = asked.get("groups") if isinstance(asked, dict) else None
    if not isinstance(groups, list) or len(groups) != count or not all(isinstance(one, int) for one in groups):
        raise errors.ConfigError(f"worker: 'coverage' needs 'groups', a number for each of {count} instances")
    ranks = asked.get("ranks")
    if not isinstance(ranks, int) or not 0 < ranks <= 64:
        raise errors.ConfigError(f"worker: 'coverage' needs 'ranks' from 1 to 64, found {ranks!r}")
    return groups, ranks
