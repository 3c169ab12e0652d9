"""The plane under moving bodies, from rendered depths of the background.

Centres of background Gaussians lie below the surface, so depths are rendered.
"""

from __future__ import annotations

import numpy as np

from ..playback import scene_player
from ..render import posed_scene, scene_renderer
from ..scene import sampling
from ..scene.cameras import Camera, reduced
from ..scene.scene import Scene
from .world import Plane

CAMERAS = 3
PIXELS = 256  # of a picture along its longer side
_SOLID = 0.7  # opacity at which a pixel shows a surface
_NEAR = 4.0  # horizontal distance from the bodies up to which the surface counts, in sizes of the largest
_LAYER = 0.05  # thickness of the layer that counts as one plane, in sizes of the smallest body
LEAST = 30  # points of a plane
_SAME = 1e-6  # distance of cameras at one place, relative to the extent of all cameras
_ROUNDS = 4
_STEEPEST = 0.26  # largest angle between the normal and the up axis, rad


def find(scene: Scene, up: np.ndarray, points: np.ndarray, size: float, reach: float | None = None) -> Plane | None:
    """Return the plane below points, or None if the pictures show none.

    Args:
        scene: The scene.
        up: Unit vector against gravity. [3]
        points: Lowest points of bodies in observed and predicted poses. [P, 3]
        size: Size of the smallest body.
        reach: Horizontal distance from the points up to which the surface counts; None for some sizes.
    """
    found, _ = surface(scene)
    if len(found) < LEAST:
        return None
    heights = found @ up
    across, among = found - heights[:, None] * up, points - (points @ up)[:, None] * up
    if reach is None:
        reach = _NEAR * max(size, float(np.ptp(among, axis=0).max()) / 4)
    distances = np.linalg.norm(across[:, None] - np.array(sampling.spread(list(among), 16)), axis=-1).min(axis=1)
    near = (distances < reach) & (heights < (points @ up).max() + size)
    return level(found[near], up, size)


def level(points: np.ndarray, up: np.ndarray, size: float) -> Plane | None:
    """Return the level plane that most points of a surface are close to, or None for too few. [P, 3]"""
    if len(points) < LEAST:
        return None
    heights, layer = points @ up, _LAYER * size
    order = np.sort(heights)
    inside = np.searchsorted(order, order + 2 * layer) - np.arange(len(order))
    return _refined(points, up, float(order[np.argmax(inside)] + layer), layer)


def _refined(points: np.ndarray, up: np.ndarray, height: float, layer: float) -> Plane | None:
    """Least-squares plane through the points in a layer, which follows the plane. [P, 3]"""
    normal = up
    for _ in range(_ROUNDS):
        rows = np.abs(points @ normal - height) < layer
        if rows.sum() < LEAST:
            return None
        middle = points[rows].mean(axis=0)
        found = np.linalg.svd(points[rows] - middle, full_matrices=False)[2][2]
        normal = found * np.sign(found @ up)
        height = float(middle @ normal)
    return Plane(normal, height) if normal @ up > np.cos(_STEEPEST) else None


def surface(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Points of the background that some cameras see at t_max, and the centres of these cameras. [P, 3] each"""
    player = scene_player.Player(scene)
    rows = np.flatnonzero((scene.gaussians.object_ids == 0) & (scene.gaussians.motion_ids == 0))
    cameras = sampling.spread(_distinct(scene.cameras), CAMERAS)
    if not len(rows) or not cameras:
        return np.zeros((0, 3)), np.zeros((0, 3))
    posed = posed_scene.rows_of(posed_scene.pose_frame(scene, player.frame(scene.t_max)), rows)
    found, origins = [], []
    for camera in cameras:
        small = reduced(camera, PIXELS)
        shown = scene_renderer.render_frame(scene, posed, small, background=None)
        y, x = np.nonzero(np.asarray(shown.alpha) > _SOLID)
        rays = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], axis=1) @ np.linalg.inv(small.intrinsics).T
        seen = rays * np.asarray(shown.depth, np.float64)[y, x, None]
        origins.append(np.broadcast_to(camera.center, seen.shape))
        found.append((seen - small.T_cam_world[:3, 3]) @ small.T_cam_world[:3, :3])
    return np.concatenate(found), np.concatenate(origins)


def _distinct(cameras: tuple[Camera, ...]) -> list[Camera]:
    """One camera for each place, to a millionth of the extent of all places."""
    if not cameras:
        return []
    centers = np.array([camera.center for camera in cameras])
    step = max(_SAME * float(np.ptp(centers, axis=0).max()), 1e-300)
    places = np.rint((centers - centers[0]) / step)
    return list({tuple(place): camera for place, camera in zip(places.tolist(), cameras, strict=True)}.values())
