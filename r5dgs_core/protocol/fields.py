"""Validation of request fields: each function returns a value, or raises a ConfigError that names the field."""

from __future__ import annotations

import math
import os
import reprlib
import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO, TypeGuard

import numpy as np

from .. import errors, strict_json
from ..scene import cameras
from ..scene.cameras import Camera
from ..scene.instance import Instance, Sky
from ..search import prompts

MAX_LINE = 512 << 20  # bytes per request; edited points and meshes are large
MAX_ENTRIES = 100_000  # per list
_MAX_PATH = 4096  # letters
_MAX_TINT = 1e6
_PIXEL_BYTES, _GAUSSIAN_BYTES = 100, 600  # approximate memory per pixel and per Gaussian during rendering
_ASSUMED_MEMORY = 4 << 30  # bytes, on systems that do not report their memory
_FIELDS = {
    "hello": (),
    "load": ("paths",),
    "points": ("keep", "new"),
    "render": ("camera", "instances", "t", "scene", "sky", "near", "distance", "want", "coverage", "meshes"),
    "query": ("text", "scene", "encoder"),
    "embed": ("texts", "encoder"),
    "export": ("scene", "format", "path", "times", "frames"),
    "contact": ("scene", "until", "bodies", "gravity", "obstacles"),
    "warm_up": (),
    "check": (),
    "shutdown": (),
}
_INSTANCE_FIELDS = ("scene", "start", "count", "points", "holdout", "matrix", "world", "tint", "t")


def read_line(stream: BinaryIO) -> bytes:
    """Read the next line; returns b"" at the end of the stream.

    Raises:
        ConfigError: The line is longer than `MAX_LINE`; it is skipped.
    """
    line = stream.readline(MAX_LINE + 1)
    if len(line) <= MAX_LINE:
        return line
    while line and not line.endswith(b"\n"):
        line = stream.readline(1 << 20)
    raise errors.ConfigError(f"worker: a request has more than {MAX_LINE >> 20} MiB")


def parse(line: bytes) -> dict[str, Any]:
    """Parse a request."""
    request = strict_json.parse(
        line, "worker: a request", errors.ConfigError, "send one JSON object a line", size=MAX_LINE
    )
    if not isinstance(request, dict):
        raise errors.ConfigError("worker: a request has to be a JSON object")
    return request


def id_of(request: dict[str, Any]) -> int | str | None:
    """Return the id of a request, which the response repeats; None if it is missing or invalid."""
    number = request.get("id")
    return number if _is_whole(number) or (isinstance(number, str) and len(number) <= 100) else None


def command_of(request: dict[str, Any]) -> str:
    """Return the command of a request, after checking that all fields are known."""
    command = request.get("command")
    if not isinstance(command, str) or command not in _FIELDS:
        known = ", ".join(_FIELDS)
        raise errors.ConfigError(f"worker: unknown command {_short(command)}; known are {known}")
    _refuse_others(request, ("id", "command", *_FIELDS[command]), f"'{command}'")
    return command


def need(request: dict[str, Any], key: str, kind: type) -> Any:
    """Return a field of the given type; lists may have at most `MAX_ENTRIES` entries."""
    value = request.get(key)
    if not isinstance(value, kind):
        raise errors.ConfigError(f"worker: '{request.get('command')}' needs '{key}', found {_short(value)}")
    if isinstance(value, list) and len(value) > MAX_ENTRIES:
        raise errors.ConfigError(f"worker: '{key}' has {len(value)} entries; expected at most {MAX_ENTRIES}")
    return value


def time_of(request: dict[str, Any]) -> float:
    """Return the scene time of a picture."""
    return _number(request.get("t"), "worker: 'render' needs 't'")


def times_of(request: dict[str, Any]) -> tuple[tuple[float, ...], tuple[int, ...] | None]:
    """Return scene times, at least one, and the number of the frame of each, or None."""
    times = need(request, "times", list)
    numbers = None if request.get("frames") is None else need(request, "frames", list)
    if not times or (numbers is not None and len(numbers) != len(times)):
        raise errors.ConfigError("worker: 'export' needs times and as many frames, or null for the frames")
    if numbers is not None and not all(_is_whole(number) for number in numbers):
        raise errors.ConfigError(f"worker: 'frames' have to be whole numbers, found {_short(numbers)}")
    found = tuple(_number(time, "worker: 'times' have to be numbers") for time in times)
    return found, None if numbers is None else tuple(numbers)


def texts_of(request: dict[str, Any]) -> list[str]:
    """Return the phrases to embed."""
    texts = need(request, "texts", list)
    if not all(isinstance(text, str) and len(text) <= prompts.MAX_LETTERS for text in texts):
        raise errors.ConfigError(
            f"worker: 'embed' needs texts of at most {prompts.MAX_LETTERS} letters, found {_short(texts)}"
        )
    return texts


def path_of(path: Any, command: str) -> str:
    """Return a path of a request."""
    if not isinstance(path, str) or not 0 < len(path) <= _MAX_PATH or "\0" in path:
        raise errors.ConfigError(f"worker: '{command}' needs paths, found {_short(path)}")
    return path


def stamp_of(path: Any) -> tuple[str, int, int]:
    """Return path, modification time and size of a scene file, which identify its state."""
    path = path_of(path, "load")
    try:
        status = Path(path).stat()
    except OSError as error:
        raise errors.SceneFileError(
            f"{path}: expected a .r5dgs file, found none ({error.strerror}); choose its new place under "
            "'Scene File' in the R5DGS tab"
        ) from error
    if not stat.S_ISREG(status.st_mode):  # a pipe or device could block forever
        raise errors.SceneFileError(f"{path}: expected a .r5dgs file, found a folder or device")
    return path, status.st_mtime_ns, status.st_size


def number_of(value: dict[str, Any], numbers: Sequence[int]) -> int:
    """Return the number of a loaded scene, from its position among the paths; the first by default."""
    number = value.get("scene", 0)
    if not _is_whole(number) or not 0 <= number < len(numbers):
        raise errors.ConfigError(f"worker: 'scene' has to be a number below {len(numbers)}, found {_short(number)}")
    return numbers[number]


def matrix_of(value: Any, size: int, what: str) -> np.ndarray:
    """Return a square matrix of finite numbers, float64. [size, size]"""
    try:
        matrix = np.asarray(value)
        if matrix.dtype.kind not in "if":
            raise TypeError
        matrix = matrix.astype(np.float64).reshape(size, size)
    except (TypeError, ValueError, OverflowError):
        raise errors.ConfigError(f"worker: {what} has to hold {size} x {size} numbers") from None
    if not (np.abs(matrix) <= cameras.FARTHEST).all():
        raise errors.ConfigError(f"worker: {what} holds values that are not finite or above {cameras.FARTHEST:g}")
    return matrix


def camera_of(value: dict[str, Any]) -> Camera:
    """Return a camera, checked for rendering."""
    _refuse_others(value, ("width", "height", "intrinsics", "T_cam_world"), "a camera")
    width, height = value.get("width"), value.get("height")
    if not (_is_whole(width) and _is_whole(height) and 0 < width <= 32768 and 0 < height <= 32768):
        raise errors.ConfigError(
            f"worker: a camera needs width and height from 1 to 32768, found {_short(width)} x {_short(height)}"
        )
    intrinsics = matrix_of(value.get("intrinsics"), 3, "the camera's intrinsics")
    camera = Camera(width, height, intrinsics, matrix_of(value.get("T_cam_world"), 4, "the camera's T_cam_world"))
    try:
        cameras.check(camera)
    except ValueError as error:
        raise errors.ConfigError(f"worker: {error}") from error
    return camera


def instance_of(value: Any, numbers: Sequence[int]) -> Instance:
    """Convert an entry of ``instances``; the rows of an edited one are 0 to 0, see `edit_of`."""
    start, count = (value.get(name) for name in ("start", "count")) if isinstance(value, dict) else (None, None)
    if isinstance(value, dict) and value.get("points") is not None:
        start = count = 0
    if not (_is_whole(start) and _is_whole(count) and start >= 0 and count >= 0):
        raise errors.ConfigError(f"worker: an instance needs start, count and matrix, found {_short(value)}")
    _refuse_others(value, _INSTANCE_FIELDS, "an instance")
    world = value.get("world")
    if world is not None:
        world = matrix_of(world, 4, f"the world of rows {start}")
    matrix = matrix_of(value.get("matrix"), 4, f"the matrix of rows {start}")
    t = value.get("t")
    if t is not None:
        t = _number(t, "worker: the time of an instance has to be a number")
    holdout = value.get("holdout", False)
    if not isinstance(holdout, bool):
        raise errors.ConfigError(f"worker: 'holdout' of an instance has to be true or false, found {_short(holdout)}")
    return Instance(start, count, matrix, number_of(value, numbers), world, _tint_of(value), t, holdout)


def edit_of(value: dict[str, Any]) -> str | None:
    """Return the key of the point edit of an entry of ``instances``, or None."""
    key = value.get("points")
    if key is not None and not isinstance(key, str):
        raise errors.ConfigError(f"worker: the 'points' of an instance have to be a key, found {_short(key)}")
    return key


def check_rows(instances: Sequence[Instance], lengths: Sequence[int]) -> None:
    """Raise ConfigError for instances with rows beyond the end of their scene.

    Args:
        instances: The instances.
        lengths: Number of Gaussians of each scene.
    """
    for one in instances:
        if one.start + one.count > lengths[one.scene]:
            raise errors.ConfigError(
                f"worker: an instance shows rows {one.start} to {one.start + one.count} of a scene of "
                f"{lengths[one.scene]} Gaussians"
            )


def check_size(camera: Camera, gaussians: int, ranks: int = 0) -> None:
    """Raise ConfigError for a picture that needs more memory than is free.

    Args:
        camera: Camera of the picture.
        gaussians: Number of rendered Gaussians.
        ranks: Coverage groups kept per pixel.
    """
    needed = camera.width * camera.height * (_PIXEL_BYTES + 16 * ranks) + gaussians * _GAUSSIAN_BYTES
    free = free_memory()
    if needed > free:
        raise errors.ConfigError(
            f"worker: a picture of {camera.width} x {camera.height} pixels with {gaussians} Gaussians needs about "
            f"{needed / 2**30:.1f} GiB of memory, of which {free / 2**30:.1f} are free; render it smaller or in parts"
        )


def free_memory() -> int:
    """Memory that a picture may use, bytes: the available memory, or half of the total if that is unknown."""
    try:
        with open("/proc/meminfo", encoding="ascii") as stream:
            return next(int(line.split()[1]) << 10 for line in stream if line.startswith("MemAvailable:"))
    except (OSError, ValueError, IndexError, StopIteration):
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    except (AttributeError, OSError, ValueError):
        return _ASSUMED_MEMORY


def sky_of(request: dict[str, Any], numbers: Sequence[int]) -> Sky | None:
    """Return the sky behind instances; None for black."""
    sky = request.get("sky")
    if sky is None:
        return None
    if not isinstance(sky, dict):
        raise errors.ConfigError(f"worker: 'sky' has to be null or scene and matrix, found {_short(sky)}")
    _refuse_others(sky, ("scene", "matrix"), "'sky'")
    return Sky(number_of(sky, numbers), matrix_of(sky.get("matrix"), 4, "the matrix of the sky"))


def _tint_of(value: dict[str, Any]) -> tuple[float, float, float] | None:
    tint = value.get("tint")
    if tint is None:
        return None
    if not (isinstance(tint, list) and len(tint) == 3 and all(map(is_number, tint))):
        raise errors.ConfigError(f"worker: a tint has to hold three factors, found {_short(tint)}")
    if not all(0 <= factor <= _MAX_TINT for factor in tint):
        raise errors.ConfigError(f"worker: a tint has to hold factors from 0 to {_MAX_TINT:g}, found {tint}")
    red, green, blue = map(float, tint)
    return red, green, blue


def distance_of(request: dict[str, Any]) -> float:
    """Return the offset from the camera at which depth starts."""
    return _number(request.get("distance", 0.0), "worker: 'distance' has to be a number")


def near_of(request: dict[str, Any]) -> float | None:
    """Return the nearest depth to render; None for the near plane of each scene."""
    near = request.get("near")
    if near is not None and not (is_number(near) and 0 < near <= cameras.FARTHEST):
        raise errors.ConfigError(f"worker: 'near' has to be a depth > 0, found {_short(near)}")
    return near


def wanted(request: dict[str, Any], known: tuple[str, ...]) -> list[str]:
    """Return the names of the requested arrays."""
    want = request.get("want", [])
    if not isinstance(want, list) or not all(isinstance(name, str) for name in want):
        raise errors.ConfigError(f"worker: 'want' has to be a list of names, found {_short(want)}")
    unknown = set(want) - set(known)
    if unknown:
        raise errors.ConfigError(f"worker: cannot render {_short(sorted(unknown))}; known are {', '.join(known)}")
    return want


def coverage_of(request: dict[str, Any]) -> tuple[list[int], int] | None:
    """Return the group of each instance and the number of groups kept per pixel; None without 'coverage'."""
    asked = request.get("coverage")
    if asked is None:
        return None
    count = len(need(request, "instances", list))
    groups = asked.get("groups") if isinstance(asked, dict) else None
    if not isinstance(groups, list) or len(groups) != count or not all(_is_whole(one) for one in groups):
        raise errors.ConfigError(f"worker: 'coverage' needs 'groups', a number for each of {count} instances")
    if not all(-1 <= one < 1 << 31 for one in groups):
        raise errors.ConfigError("worker: 'coverage' needs 'groups' from -1 to 2147483647")
    ranks = asked.get("ranks")
    if not _is_whole(ranks) or not 0 < ranks <= 64:
        raise errors.ConfigError(f"worker: 'coverage' needs 'ranks' from 1 to 64, found {_short(ranks)}")
    return groups, ranks


def _refuse_others(value: dict[str, Any], known: Sequence[str], what: str) -> None:
    others = [name for name in value if name not in known]
    if others:
        raise errors.ConfigError(
            f"worker: {what} has unknown fields {_short(others)}; known are {', '.join(known) or 'none'}"
        )


def _number(value: Any, problem: str) -> float:
    if not is_number(value) or abs(value) > cameras.FARTHEST:
        raise errors.ConfigError(f"{problem}, found {_short(value)}")
    return float(value)


def is_number(value: Any) -> TypeGuard[int | float]:
    """Return True for finite numbers, but not for booleans."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_whole(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def _short(value: Any) -> str:
    """Return the repr of a value, shortened for messages."""
    return reprlib.repr(value)
