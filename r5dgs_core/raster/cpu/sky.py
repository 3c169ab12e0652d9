"""Kernel for rendering a sky: spherical harmonics along the ray of each pixel, clamped to [0, 1].

Every step processes a row of pixels, so that the compiler can vectorize it for any degree.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32

from ...scene.spherical_harmonics import C0
from ..compilation import helper, kernel
from .sh_kernels import BASES, evaluate_basis


@kernel
def draw_sky(worker, workers, rays, sh, image):
    """Render the worker's share of the rows.

    Args:
        rays: Map from pixel coordinates (x, y, 1) to directions in the sky's frame, not normalised. [3, 3] float64
        sh: Coefficients; K = 4, 9 or 16. [K, 3] float64
        image: Result. [H, W, 3] float32
    """
    height, width = image.shape[:2]
    count = len(sh)
    basis, row = np.empty((BASES, width), np.float32), np.empty(width, np.float32)
    for y in range(height * worker // workers, height * (worker + 1) // workers):
        _evaluate_row(rays, y + 0.5, count, basis)
        for c in range(3):
            row[:] = float32(0.5 + C0 * sh[0, c])
            for k in range(1, count):
                _add_scaled(row, float32(sh[k, c]), basis[k])
            for x in range(width):
                image[y, x, c] = min(max(row[x], float32(0)), float32(1))


@helper
def _evaluate_row(rays, y, count, basis):
    """Evaluate the basis functions for a row of pixels. [K, W]"""
    values = np.empty(BASES, np.float32)
    a, b, c = rays[0, 1] * y + rays[0, 2], rays[1, 1] * y + rays[1, 2], rays[2, 1] * y + rays[2, 2]
    for x in range(basis.shape[1]):
        u, v, w = rays[0, 0] * (x + 0.5) + a, rays[1, 0] * (x + 0.5) + b, rays[2, 0] * (x + 0.5) + c
        inverse = 1 / math.sqrt(u * u + v * v + w * w)
        evaluate_basis(u * inverse, v * inverse, w * inverse, count, values)
        for k in range(1, count):
            basis[k, x] = values[k]


@helper
def _add_scaled(row, scale, values):
    for x in range(len(row)):
        row[x] += scale * values[x]
