"""Arrangement of the cameras: common view, angles between them, size of the images."""

from __future__ import annotations

import functools

import numpy as np

from ...data.dataset import Dataset
from ...findings import Collector
from ...prepare.image_size import MOST_LINES
from ...scene.cameras import Camera, project
from . import pictures
from .pictures import Album

COMMON = 0.02  # least share of a camera's view that another camera sees
SMALL_DEG = 5.0  # angle between the outermost cameras below which a rig is too narrow
MOST_CAMERAS = 40  # number of compared cameras; of more, an even selection
_DEPTHS = np.geomspace(0.2, 3.0, 12)  # of the compared points, in distances to the middle
_GRID = 7


def check(found: Dataset, collect: Collector, album: Album) -> None:
    """Check the cameras of the training views."""
    cameras = list({view.camera.name: view.camera for view in found.train}.values())
    cameras = cameras[:: max(1, len(cameras) // MOST_CAMERAS)]
    _check_size(found, collect, album)
    if len(cameras) < 2:
        return
    middle = focus(cameras)
    alone = [camera for camera, share in zip(cameras, common_views(cameras, middle), strict=True) if share < COMMON]
    for camera in alone:
        picture = album.write(f"D60_{camera.name}", functools.partial(pictures.plan, cameras, middle, [camera.name]))
        collect.add("D60", f"{found.root}: no other camera sees what {camera.name} sees", picture=picture)
    angle = widest_angle(cameras, middle)
    if angle < SMALL_DEG and not alone:
        picture = album.write(
            "D61", functools.partial(pictures.plan, cameras, middle, [camera.name for camera in cameras])
        )
        collect.add(
            "D61",
            f"{found.root}: all cameras look from nearly the same direction, {angle:.1f} degrees apart at most",
            picture=picture,
        )


def focus(cameras: list[Camera]) -> np.ndarray:
    """Return the point nearest to all optical axes; of several, the one nearest to the cameras' centre. [3]"""
    centers = np.stack([camera.center for camera in cameras])
    axes = np.stack([camera.T_cam_world[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    start = centers.mean(0)
    offset = np.linalg.lstsq(across.sum(0), (across @ (centers - start)[:, :, None])[..., 0].sum(0), rcond=1e-6)[0]
    return start + offset


def common_views(cameras: list[Camera], middle: np.ndarray) -> np.ndarray:
    """Return the largest share of each camera's view that another camera sees. [C]"""
    distances = [float(np.linalg.norm(camera.center - middle)) for camera in cameras]
    typical = float(np.median(distances)) or 1.0
    best = np.zeros(len(cameras))
    for k, camera in enumerate(cameras):
        v, u = np.meshgrid(np.linspace(0.5, camera.height - 0.5, _GRID), np.linspace(0.5, camera.width - 0.5, _GRID))
        rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], 1) @ np.linalg.inv(camera.intrinsics).T
        world = rays @ camera.T_cam_world[:3, :3]
        points = camera.center + (typical * _DEPTHS)[:, None, None] * world  # [depths, rays, 3]
        shares = [_inside(other, points.reshape(-1, 3)).mean() for n, other in enumerate(cameras) if n != k]
        best[k] = max(shares)
    return best


def _inside(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Mask of points that a camera sees. [N]"""
    pixels, _ = project(camera, points)  # NaN behind the camera
    return np.all((pixels >= 0) & (pixels <= (camera.width, camera.height)), axis=1)


def widest_angle(cameras: list[Camera], middle: np.ndarray) -> float:
    """Return the largest angle between two cameras, seen from the middle; degrees."""
    directions = np.stack([camera.center - middle for camera in cameras])
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    return float(np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1)).max()))


def _check_size(found: Dataset, collect: Collector, album: Album) -> None:
    largest = max(found.train, key=lambda view: view.camera.height)
    if largest.camera.height > MOST_LINES:
        picture = album.write("D70", lambda: pictures.resolution(largest, MOST_LINES))
        collect.add(
            "D70",
            f"{found.root}: images of {largest.camera.height} lines, expected up to {MOST_LINES}; the Gaussians of a "
            f"scene do not show more. Remedy: prepare again with --size {MOST_LINES}, which also trains faster",
            picture=picture,
        )
