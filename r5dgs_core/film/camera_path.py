"""Camera paths: a still camera, an orbit, and curves or lines through cameras."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..motion import cubic_curves, rotations
from ..render import viewpoints
from ..scene import cameras as axes
from ..scene.cameras import Camera
from ..scene.scene import Scene


@dataclass(frozen=True)
class CameraPath:
    """Path of a camera.

    Attributes:
        cameras: Function from a number of frames to their cameras, all of one image size.
        moves: True if these cameras differ.
        count: Number of frames that the path was made for, or None.
        times: Scene times, evenly spaced along the path, or None.
        fps: Frames per second that the path was made for, or None.
    """

    cameras: Callable[[int], list[Camera]]
    moves: bool = True
    count: int | None = None
    times: np.ndarray | None = None
    fps: float | None = None


def still(camera: Camera) -> CameraPath:
    """Return the path of a camera that does not move."""
    return CameraPath(lambda count: [camera] * count, moves=False)


def orbit(scene: Scene) -> CameraPath:
    """Return a circle around the objects of a scene about the vertical axis of its world, starting at its first camera.

    The last frame is one step before the first, so that the film can loop.
    """
    start = scene.cameras[0] if scene.cameras else viewpoints.overview(scene)
    up = axes.WORLD_TO_BLENDER[scene.world_convention].T @ np.array([0.0, 0.0, 1.0])
    seen = scene.gaussians.means[scene.gaussians.object_ids > 0]
    points = seen if len(seen) else scene.gaussians.means
    middle = np.median(points.astype(np.float64), axis=0) if len(points) else np.zeros(3)

    def turned(angle_rad: float) -> Camera:
        turn = np.eye(4)
        turn[:3, :3] = rotations.quats_to_rotmats(rotations.rotvecs_to_quats(angle_rad * up))
        turn[:3, 3] = middle - turn[:3, :3] @ middle
        return dataclasses.replace(start, T_cam_world=start.T_cam_world @ np.linalg.inv(turn), name="orbit")

    return CameraPath(lambda count: [turned(2 * np.pi * k / count) for k in range(count)])


def curve(keys: Sequence[Camera]) -> CameraPath:
    """Return a smooth path through cameras at a nearly constant speed, with the image size of the first camera."""
    return CameraPath(lambda count: _between(keys, count, smooth=True))


def lines(keys: Sequence[Camera], times: np.ndarray | None, fps: float | None) -> CameraPath:
    """Return a path of lines between cameras, in equal steps; with one frame per camera, frames have their poses."""
    return CameraPath(lambda count: _between(keys, count, smooth=False), True, len(keys), times, fps)


def fitted(camera: Camera, width: int, height: int) -> Camera:
    """Return a camera with another image size and the whole view; if its shape differs, two sides show more."""
    size, left, top = placement((camera.width, camera.height), (width, height))
    return axes.crop(axes.resize(camera, *size), -left, -top, width, height)


def placement(size: tuple[int, int], into: tuple[int, int]) -> tuple[tuple[int, int], int, int]:
    """Return size, left and top of a picture that is scaled as a whole into the middle of another one, in pixels."""
    scale = min(into[0] / size[0], into[1] / size[1])
    width, height = (max(round(scale * side), 1) for side in size)
    return (width, height), -((width - into[0]) // 2), -((height - into[1]) // 2)


def _between(keys: Sequence[Camera], count: int, *, smooth: bool) -> list[Camera]:
    """Return cameras at even distances along a path from the first to the last key."""
    first = keys[0]
    same_size = [fitted(key, first.width, first.height) for key in keys]
    centers = np.array([key.center for key in same_size])
    quats = rotations.rotmats_to_quats(np.array([key.T_cam_world[:3, :3].T for key in same_size]))
    quats = rotations.make_continuous(quats)
    lenses = np.array([key.intrinsics.ravel() for key in same_size])
    values = np.concatenate([centers, quats, lenses], axis=1)
    knots = _knots(centers, quats) if smooth else np.arange(len(keys), dtype=np.float64)
    places = np.linspace(0, knots[-1], count)
    if len(keys) == 1:
        found = np.repeat(values, count, axis=0)
    elif smooth:
        slopes = cubic_curves.slopes(knots, values)
        found = cubic_curves.evaluate(cubic_curves.Keys(knots, values, slopes, slopes), places)
    else:
        k, _, u = cubic_curves.locate(knots, places)
        found = values[k] * (1 - u[:, None]) + values[k + 1] * u[:, None]
    return [_camera(first, row) for row in found]


def _knots(centers: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """Places of cameras along a path by distance and angle; neighbours are never at one place. [K]"""
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    turns = 2 * np.arccos(np.clip(np.abs((quats[1:] * quats[:-1]).sum(1)), 0, 1))
    size = np.linalg.norm(centers - centers.mean(0), axis=1).max() or 1.0
    lengths = steps / size + turns
    return np.concatenate([[0.0], np.cumsum(np.maximum(lengths, 1e-3 * lengths.max() + 1e-9))])


def _camera(like: Camera, row: np.ndarray) -> Camera:
    """Return the camera of a row of `_between`: centre, rotation to the world, camera matrix."""
    rotation = rotations.quats_to_rotmats(rotations.normalize(row[3:7])).T
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3], T_cam_world[:3, 3] = rotation, -rotation @ row[:3]
    return Camera(like.width, like.height, row[7:].reshape(3, 3), T_cam_world, "path")
