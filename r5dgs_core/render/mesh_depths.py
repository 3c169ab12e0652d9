"""Depths of triangle meshes in a picture, as the z-buffer of a camera."""

from __future__ import annotations

import math

import numpy as np

from ..raster.compilation import helper, kernel
from ..raster.thread_pool import run
from ..scene.cameras import Camera

MARGIN = 2  # px by which meshes extend past their outlines; render engines filter pixels over up to 1.5 px


def draw(camera: Camera, vertices: np.ndarray, triangles: np.ndarray, near: float) -> np.ndarray:
    """Return the depth of the nearest surface at each pixel centre.

    Empty pixels within `MARGIN` of a mesh take the smallest depth around them, so that each pixel that a mesh partly
    covers has a depth.

    Args:
        camera: The camera.
        vertices: Corners, in the world of the camera. [V, 3]
        triangles: Corners of each triangle, visible from both sides. [T, 3] int32
        near: Depth at which triangles are clipped, > 0.

    Returns:
        Depths along the camera's axis; infinite if no mesh is there. [H, W] float32
    """
    T = camera.T_cam_world
    local = np.ascontiguousarray(np.asarray(vertices, np.float64) @ T[:3, :3].T + T[:3, 3])
    depths = np.full((camera.height, camera.width), np.inf, np.float32)
    faces = np.ascontiguousarray(triangles, np.int64).reshape(-1, 3)
    lens = np.ascontiguousarray(camera.intrinsics[:2], np.float64)
    run(_draw, camera.height // 32, local, faces, lens, float(near), depths)
    return _widened(depths)


def _widened(depths: np.ndarray) -> np.ndarray:
    """Extend finite depths by `MARGIN` pixels."""
    padded = np.pad(depths, MARGIN, constant_values=np.inf)
    height, width = depths.shape
    steps = range(2 * MARGIN + 1)
    rows = np.min([padded[y : y + height] for y in steps], axis=0)
    least = np.min([rows[:, x : x + width] for x in steps], axis=0)
    return np.where(np.isfinite(depths), depths, least)


@kernel
def _draw(worker, workers, vertices, triangles, lens, near, depths):
    """Draw all triangles into the worker's share of the rows."""
    height = depths.shape[0]
    top, bottom = height * worker // workers, height * (worker + 1) // workers
    polygon, corners = np.empty((4, 3)), np.empty((4, 3))
    for t in range(len(triangles)):
        count = _clip(vertices, triangles[t], near, polygon)
        for k in range(count):
            x, y, inverse = polygon[k, 0], polygon[k, 1], 1 / polygon[k, 2]
            corners[k, 0] = (lens[0, 0] * x + lens[0, 1] * y) * inverse + lens[0, 2]
            corners[k, 1] = (lens[1, 0] * x + lens[1, 1] * y) * inverse + lens[1, 2]
            corners[k, 2] = inverse
        for k in range(2, count):
            _fill(corners[0], corners[k - 1], corners[k], top, bottom, depths)


@helper
def _clip(vertices, triangle, near, polygon):
    """Clip a triangle at the near plane; returns the number of corners, 0, 3 or 4."""
    count = 0
    for k in range(3):
        a, b = vertices[triangle[k]], vertices[triangle[(k + 1) % 3]]
        if a[2] >= near:
            polygon[count] = a
            count += 1
        if (a[2] >= near) != (b[2] >= near):
            share = (near - a[2]) / (b[2] - a[2])
            for c in range(3):
                polygon[count, c] = a[c] + share * (b[c] - a[c])
            polygon[count, 2] = near
            count += 1
    return count


@helper
def _fill(a, b, c, top, bottom, depths):
    """Draw a triangle of corners (x, y, 1 / z) in pixels: 1 / z is linear over the image."""
    area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if area == 0 or not math.isfinite(area):
        return
    low_x, high_x = min(a[0], b[0], c[0]), max(a[0], b[0], c[0])
    low_y, high_y = min(a[1], b[1], c[1]), max(a[1], b[1], c[1])
    first_y, end_y = int(max(top, math.ceil(low_y - 0.5))), int(min(bottom, math.floor(high_y - 0.5) + 1))
    first_x, end_x = int(max(0, math.ceil(low_x - 0.5))), int(min(depths.shape[1], math.floor(high_x - 0.5) + 1))
    for row in range(first_y, end_y):
        y = row + 0.5
        for column in range(first_x, end_x):
            x = column + 0.5
            u = ((b[0] - x) * (c[1] - y) - (c[0] - x) * (b[1] - y)) / area
            v = ((c[0] - x) * (a[1] - y) - (a[0] - x) * (c[1] - y)) / area
            w = 1 - u - v
            if u >= 0 and v >= 0 and w >= 0:
                depth = np.float32(1 / (u * a[2] + v * b[2] + w * c[2]))
                if depth < depths[row, column]:
                    depths[row, column] = depth
