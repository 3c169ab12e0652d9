"""Triangle mesh of the surface that a depth picture shows."""

from __future__ import annotations

import numpy as np

from ..scene.cameras import Camera

GRAZING = 0.05  # minimum cosine between the normal of a triangle and the ray; others bridge two surfaces


def triangulate(camera: Camera, depths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return one vertex per pixel with a depth, and two triangles per square of such pixels.

    Triangles that are seen at a grazing angle are left out: nearly all of them connect a surface with another one
    behind it.

    Args:
        camera: Camera of the picture.
        depths: z in the frame of the camera; not finite without a surface. [H, W]

    Returns:
        Vertices in the world [V, 3] float64, and triangles, counter-clockwise as the camera sees them [T, 3] int32.
    """
    height, width = depths.shape
    rows, columns = np.mgrid[:height, :width] + 0.5
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
    points = (rays * np.where(np.isfinite(depths), depths, 0.0)[..., None]).reshape(-1, 3)
    corner = np.arange(height * width, dtype=np.int32).reshape(height, width)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    triangles = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    triangles = triangles[np.isfinite(depths.reshape(-1)[triangles]).all(axis=1)]
    triangles = triangles[_facing(points[triangles]) > GRAZING]
    used, renumbered = np.unique(triangles, return_inverse=True)
    T = camera.T_cam_world
    world = (points[used] - T[:3, 3]) @ T[:3, :3]
    return world, renumbered.reshape(-1, 3).astype(np.int32)


def _facing(corners: np.ndarray) -> np.ndarray:
    """Absolute cosine between the normal of each triangle and the ray to its centre. [T, 3, 3] -> [T]"""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    rays = corners.mean(axis=1)
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(rays, axis=1)
    return np.abs((normals * rays).sum(axis=1)) / np.maximum(lengths, 1e-300)
