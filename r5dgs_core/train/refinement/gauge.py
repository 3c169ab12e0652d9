"""Gauge of the poses: a change of the world that all cameras share corrects nothing.

A correction of a pose is x = (rotation, shift) in the camera's axes. A small similarity of the world, with rotation a,
translation b and scale c, changes all corrections by J (a, b, c); the images do not determine it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...motion import rotations
from ...scene import cameras
from ...scene.cameras import Camera

FLOOR = 0.02  # smallest eigenvalue of the flow of a pose's parameters, relative to the mean
POINTS = 3000  # points whose motion in the image sets the units of a pose
FREEDOM = 7  # parameters of a similarity of the world


def similarity_slopes(camera: Camera) -> np.ndarray:
    """Return the change of a pose's correction by a small similarity of the world. [6, 7]"""
    rotation, shift = camera.T_cam_world[:3, :3], camera.T_cam_world[:3, 3]
    slopes = np.zeros((6, 7))
    slopes[:3, :3] = rotation
    slopes[3:, :3] = rotations.skew(shift) @ rotation
    slopes[3:, 3:6] = rotation
    slopes[3:, 6] = -shift
    return slopes


def pixel_units(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return pose corrections, as columns, each of which moves the image of the points by one pixel (rms).

    The columns are the principal axes of the motion in the image, which separates a rotation from a shift that looks
    almost the same; weak axes are shortened.

    Args:
        camera: The camera.
        points: Points of the scene. [N, 3]

    Returns:
        [6, 6]
    """
    pixels, depth = cameras.project(camera, points)
    shown = depth > 0
    shown &= ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(1)
    p = points[shown] @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3]
    if len(p) < 10:
        return np.eye(6) / camera.intrinsics[0, 0]
    focal = np.diag(camera.intrinsics)[:2]
    by_point = np.zeros((len(p), 2, 3))
    by_point[:, 0, 0], by_point[:, 1, 1] = focal[0] / p[:, 2], focal[1] / p[:, 2]
    by_point[:, :, 2] = -by_point[:, [0, 1], [0, 1]] * p[:, :2] / p[:, 2:]
    slopes = np.concatenate([by_point @ -rotations.skew(p), by_point], axis=2)  # [N, 2, 6]
    flow = np.einsum("nij,nik->jk", slopes, slopes) / len(p)
    scale = 1 / np.sqrt(np.diag(flow))
    values, axes = np.linalg.eigh(flow * np.outer(scale, scale))
    return scale[:, None] * axes / np.sqrt(np.maximum(values, FLOOR))


class Gauge:
    """Projection of the corrections of all poses to those that no similarity of the world explains.

    Args:
        rig: Given camera of each pose.
        units: Corrections of a pixel of each pose, as from `pixel_units`; they weight the corrections. [R, 6, 6]
    """

    def __init__(self, rig: Sequence[Camera], units: np.ndarray):
        self._slopes = np.stack([similarity_slopes(camera) for camera in rig])
        weighted = np.linalg.solve(units, self._slopes).reshape(-1, 7)
        self._inverse = np.linalg.pinv(weighted, rcond=1e-6)
        self._units = units

    def fix(self, corrections: np.ndarray) -> np.ndarray:
        """Return the corrections without the similarity that they share. [R, 6]"""
        weighted = np.linalg.solve(self._units, corrections[..., None]).ravel()
        return corrections - self._slopes @ (self._inverse @ weighted)
