"""Frames of a film: camera and scene time of each."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .. import errors
from ..render import viewpoints
from ..scene import cameras, predictability
from ..scene.cameras import Camera
from ..scene.scene import Scene
from . import camera_path, path_file
from .camera_path import CameraPath
from .settings import Settings

FPS = 24.0
STILL_SECONDS = 5.0  # length of a film in which only the camera moves
MAX_FRAMES = 100_000


@dataclass(frozen=True)
class Shot:
    """One frame.

    Attributes:
        number: Number of the frame in the film, from 1 on.
        camera: The camera, in the scene's world, at the size of the picture.
        t: Scene time.
    """

    number: int
    camera: Camera
    t: float


@dataclass(frozen=True)
class Schedule:
    """Frames of a film.

    Attributes:
        shots: The frames, at least one.
        fps: Frames per second.
        span: First and last time on the time marker.
    """

    shots: tuple[Shot, ...]
    fps: float
    span: tuple[float, float]


def make(scene: Scene, settings: Settings) -> Schedule:
    """Return the frames of a film.

    Raises:
        ConfigError: A camera or camera path cannot be used, or the times are before the first observed one.
    """
    path = _path(scene, settings)
    fps = settings.fps or path.fps or FPS
    first, horizon = float(scene.tracks.times[0]), max(predictability.horizon(scene), scene.t_max)
    if settings.time is not None and settings.time[0] < first:
        raise errors.ConfigError(f"--time {settings.time[0]:g}: {_expected(first)}")
    if not settings.is_folder and not settings.is_video:
        t = scene.t_max if settings.time is None else settings.time[0]
        return Schedule((_shot(settings, 1, path.cameras(1)[0], t),), fps, (first, max(horizon, t)))
    start, end = (first, horizon) if settings.time is None else settings.time
    count = _count(scene, settings, path, fps, end - start)
    times = np.linspace(start, end, count)
    if settings.time is None and path.times is not None:
        own = path.times
        if own.min() < first:
            raise errors.ConfigError(f"--camera {settings.camera[0]}: 'render_time' {own.min():g}: {_expected(first)}")
        times = np.interp(np.linspace(0, len(own) - 1, count), np.arange(len(own)), own)
    found = zip(path.cameras(count), times.tolist(), strict=True)
    shots = tuple(_shot(settings, number, camera, t) for number, (camera, t) in enumerate(found, 1))
    low, high = float(times.min()), float(times.max())
    return Schedule(shots, fps, (low, high) if low < high else (first, max(horizon, high)))


def _expected(first: float) -> str:
    return f"expected scene times from the first observed one, {first:g}, on"


def _path(scene: Scene, settings: Settings) -> CameraPath:
    """Return the path that ``--camera`` names."""
    names = settings.camera
    if len(names) > 1:
        return camera_path.curve([_named(scene, name, "orbits and camera paths are given alone") for name in names])
    if not names:
        return camera_path.still(scene.cameras[0] if scene.cameras else viewpoints.overview(scene))
    known = {camera.name for camera in scene.cameras}
    if names[0] == "orbit" and "orbit" not in known:
        return camera_path.orbit(scene)
    if names[0].lower().endswith(".json") and names[0] not in known:
        return path_file.read(Path(names[0]), scene.origin)
    return camera_path.still(_named(scene, names[0], "or orbit, or a camera path (.json)"))


def _named(scene: Scene, name: str, further: str) -> Camera:
    try:
        return viewpoints.named(scene, name)
    except errors.ConfigError as error:
        raise errors.ConfigError(f"{error}; {further}") from error


def _count(scene: Scene, settings: Settings, path: CameraPath, fps: float, duration: float) -> int:
    """Return the number of frames of a film over ``duration`` units of scene time."""
    if settings.seconds is None and path.count is not None:
        count = path.count
    else:
        pace = scene.units.seconds_per_unit or scene.frames_per_unit / FPS
        seconds = pace * duration if duration > 0 else STILL_SECONDS if path.moves else 0.0
        count = max(round((seconds if settings.seconds is None else settings.seconds) * fps), 1)
    if count > MAX_FRAMES:
        raise errors.ConfigError(
            f"--seconds: the film would have {count} frames, more than {MAX_FRAMES}; choose a shorter one"
        )
    return count


def _shot(settings: Settings, number: int, camera: Camera, t: float) -> Shot:
    width, height = camera.width, camera.height
    if settings.size is not None:
        width, height = settings.size
        if width == 0:
            resized = cameras.resized(camera, height)
            width, height = resized.width, resized.height
    if settings.even:
        width, height = max(width - width % 2, 2), max(height - height % 2, 2)
    if (width, height) != (camera.width, camera.height):
        camera = camera_path.fitted(camera, width, height)
    return Shot(number, dataclasses.replace(camera, width=width, height=height), t)
