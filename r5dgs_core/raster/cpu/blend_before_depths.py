"""Blending of the Gaussians that lie before a surface, such as a mesh, of known depth at each pixel."""

from __future__ import annotations

import math

from ..compilation import helper, kernel
from .projection import EXTENT_X, EXTENT_Y, L11, L12, L22, LOG2_OPACITY, MEAN_X, MEAN_Y


@kernel
def blend(worker, workers, geometry, lines, colors, rays, depths, least, most, finished, layer):
    """Blend Gaussians, sorted from near to far, into the worker's share of the rows.

    Args:
        worker: Number of the worker.
        workers: Number of workers.
        geometry: Projected Gaussians, with the columns of `projection`. [n, GEOMETRY]
        lines: Exponents along rays: the form xx, xy, xz, yy, yz, zz, and the linear part. [n, 9]
        colors: Their colours. [n, 3]
        rays: Inverse of the intrinsics. [3, 3]
        depths: Depth of the surface at each pixel; infinite pixels are left out. [H, W]
        least: Smallest alpha that counts.
        most: Largest alpha.
        finished: Transmittance below which a pixel takes no more Gaussians.
        layer: Output: premultiplied colours and alpha. [H, W, 4]
    """
    height, width = depths.shape
    top, bottom = height * worker // workers, height * (worker + 1) // workers
    log2_least = math.log2(least)
    for i in range(len(geometry)):
        g, line = geometry[i], lines[i]
        first_y = max(top, int(math.ceil(g[MEAN_Y] - g[EXTENT_Y] - 0.5)))
        end_y = min(bottom, int(math.floor(g[MEAN_Y] + g[EXTENT_Y] - 0.5)) + 1)
        first_x = max(0, int(math.ceil(g[MEAN_X] - g[EXTENT_X] - 0.5)))
        end_x = min(width, int(math.floor(g[MEAN_X] + g[EXTENT_X] - 0.5)) + 1)
        for row in range(first_y, end_y):
            v = g[L22] * (row + 0.5 - g[MEAN_Y])
            for column in range(first_x, end_x):
                depth, passed = depths[row, column], 1 - layer[row, column, 3]
                if not depth < math.inf or passed < finished:
                    continue
                u = g[L11] * (column + 0.5 - g[MEAN_X]) - g[L12] * (row + 0.5 - g[MEAN_Y])
                exponent = g[LOG2_OPACITY] - u * u - v * v
                if exponent < log2_least:
                    continue
                alpha = min(most, 2.0**exponent) * _share_in_front(line, rays, column + 0.5, row + 0.5, depth)
                for c in range(3):
                    layer[row, column, c] += passed * alpha * colors[i, c]
                layer[row, column, 3] += passed * alpha


@helper
def _share_in_front(line, rays, x, y, depth):
    """Share of a Gaussian's density along the ray of a pixel that lies nearer than a depth."""
    a = rays[0, 0] * x + rays[0, 1] * y + rays[0, 2]
    b = rays[1, 1] * y + rays[1, 2]
    form = a * (line[0] * a + 2 * (line[1] * b + line[2])) + b * (line[3] * b + 2 * line[4]) + line[5]
    middle = (a * line[6] + b * line[7] + line[8]) / form
    return 0.5 * math.erfc((middle - depth) * math.sqrt(0.5 * form))
