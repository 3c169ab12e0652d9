"""Normalised coordinates: the origin is the cameras' focus, and their typical distance to it is four units.

In these coordinates, learning rates and thresholds have the same meaning in scenes of any size, and float32 keeps its
precision far from the data set's origin.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..scene.cameras import Camera

TARGET_DISTANCE = 4.0


@dataclass(frozen=True)
class Normalization:
    """x_normalised = (x_world - origin) / scale.

    Attributes:
        origin: World point that becomes the origin. [3] float64
        scale: World units per normalised unit.
    """

    origin: np.ndarray
    scale: float

    def camera(self, camera: Camera) -> Camera:
        """Return the camera in normalised coordinates."""
        T = camera.T_cam_world.copy()
        T[:3, 3] = (T[:3, 3] + T[:3, :3] @ self.origin) / self.scale
        return dataclasses.replace(camera, T_cam_world=T)

    def points_to_world(self, points: np.ndarray) -> np.ndarray:
        """Convert points to world coordinates. [..., 3]"""
        return np.asarray(points, np.float64) * self.scale + self.origin


def from_cameras(cameras: Sequence[Camera]) -> Normalization:
    """Estimate the focus and the scale of a set of cameras.

    The focus is the point nearest to all optical axes (least squares). If it is not determined or lies behind most
    cameras (parallel or outward-facing cameras), it is placed in front of the cameras' centroid, and the spread of the
    cameras sets the scale.

    Args:
        cameras: At least one camera.

    Returns:
        The normalisation.
    """
    centers = np.stack([c.center for c in cameras])
    forward = np.stack([c.forward for c in cameras])
    projector = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    system = projector.mean(0)
    eigenvalues = np.linalg.eigvalsh(system)
    spread = float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
    rounding = 1e-9 * float(np.abs(centers).max())  # cameras at one place differ by less
    if eigenvalues[0] > 1e-3:
        focus = np.linalg.solve(system, np.einsum("nij,nj->i", projector, centers) / len(cameras))
        depth = np.einsum("nj,nj->n", focus - centers, forward)
        if np.mean(depth > 0) > 0.7 and np.median(depth) > rounding:
            return Normalization(focus, float(np.median(depth)) / TARGET_DISTANCE)
    if spread > rounding:
        return Normalization(centers.mean(0) + forward.mean(0) * spread, spread / TARGET_DISTANCE * 2)
    return Normalization(centers.mean(0) + forward.mean(0) * TARGET_DISTANCE, 1.0)
