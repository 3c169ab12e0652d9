"""Camera paths of nerfstudio: ``camera_path.json``, as its viewer and its Blender add-on write it.

Keys: ``camera_path``, a list with ``camera_to_world`` (16 numbers by row, OpenGL axes), ``fov`` (vertical, degrees) and
optionally ``render_time`` (scene time); ``render_width``, ``render_height``, ``fps`` and ``camera_type``.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from .. import errors, strict_json
from ..scene import cameras as axes
from ..scene.cameras import Camera
from . import camera_path
from .settings import FPS_RANGE


def read(path: Path, origin: np.ndarray) -> camera_path.CameraPath:
    """Read a camera path.

    Args:
        path: The file; its positions are in the world of the data set.
        origin: Point of that world that the scene's positions are relative to. [3]

    Raises:
        ConfigError: The file is missing, damaged, or has cameras that are not perspective.
    """
    if not path.is_file():
        raise errors.ConfigError(f"--camera {path}: expected a camera path of nerfstudio, found no file")
    content = strict_json.read(path, errors.ConfigError)
    if not isinstance(content, dict) or not isinstance(content.get("camera_path"), list) or not content["camera_path"]:
        raise errors.ConfigError(f"{path}: expected an object with a list 'camera_path' of at least one camera")
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise errors.ConfigError(f"{path}: 'camera_type': expected perspective, found {kind!r:.40}; export it again")
    width, height = (int(_number(path, content, key, 1, axes.MAX_SIDE)) for key in ("render_width", "render_height"))
    entries = content["camera_path"]
    keys = [_camera(f"{path}: camera_path[{k}]", entry, width, height, origin) for k, entry in enumerate(entries)]
    times = None
    if all("render_time" in entry for entry in entries):
        times = np.array([_number(f"{path}: camera_path[{k}]", e, "render_time") for k, e in enumerate(entries)])
    fps = None if content.get("fps") is None else _number(path, content, "fps", *FPS_RANGE)
    return camera_path.lines(keys, times, fps)


def _camera(place: str, entry: Any, width: int, height: int, origin: np.ndarray) -> Camera:
    matrix = entry.get("camera_to_world") if isinstance(entry, dict) else None
    try:
        values = np.array(matrix, np.float64).reshape(4, 4)
    except (TypeError, ValueError) as error:
        raise errors.ConfigError(f"{place}: 'camera_to_world': expected 16 numbers by row") from error
    fov = math.radians(_number(place, entry, "fov", 0.1, 179.0))
    focal = 0.5 * height / math.tan(0.5 * fov)
    intrinsics = np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1.0]])
    values[:3, 3] -= origin
    with np.errstate(all="ignore"):
        camera = Camera(width, height, intrinsics, axes.opengl_to_cam_world(values), "path")
    try:
        axes.check(camera)
    except ValueError as error:
        raise errors.ConfigError(f"{place}: 'camera_to_world': {error}") from error
    return camera


def _number(place: Any, entry: dict[str, Any], key: str, low: float = -math.inf, high: float = math.inf) -> float:
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        bounds = "" if low == -math.inf else f" from {low:g} to {high:g}"
        raise errors.ConfigError(f"{place}: {key!r}: expected a number{bounds}, found {value!r:.40}")
    return float(value)
