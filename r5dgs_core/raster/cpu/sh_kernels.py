"""Kernels for the colours of Gaussians from spherical harmonics, forward and backward.

Notation: d = A (mean - eye) / |A (mean - eye)| viewing direction in the frame of the coefficients; b_k(d) basis
functions beyond the constant one, k = 1 .. K - 1, in the order of `spherical_harmonics.basis`. A colour is

    factor max(0, 0.5 + C0 sh_0 + sum_k b_k(d) sh_k)

Directions and basis are computed in float64, so that an eye far from the origin loses no digits; sums over k are
float32. Coefficients come as two flat arrays with strides, degree 0 and the rest. They can be one array [N, K, 3], or
the two parameters of training.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32

from ...scene.spherical_harmonics import C0, C1, C2_XX_YY, C2_XY, C2_ZZ, C3_0, C3_1, C3_2, C3_2_DIFFERENCE, C3_3
from ..compilation import helper, kernel

BASES = 16  # up to degree 3


@helper
def _direction(means, eyes, view_maps, i, pose):
    """Unit direction d of Gaussian i, and the inverse of its length before normalisation; all zero at the eye."""
    a = np.float64(means[i, 0]) - eyes[pose, 0]
    b = np.float64(means[i, 1]) - eyes[pose, 1]
    c = np.float64(means[i, 2]) - eyes[pose, 2]
    x = view_maps[pose, 0, 0] * a + view_maps[pose, 0, 1] * b + view_maps[pose, 0, 2] * c
    y = view_maps[pose, 1, 0] * a + view_maps[pose, 1, 1] * b + view_maps[pose, 1, 2] * c
    z = view_maps[pose, 2, 0] * a + view_maps[pose, 2, 1] * b + view_maps[pose, 2, 2] * c
    square = x * x + y * y + z * z
    inverse = 1 / math.sqrt(square) if square > 0 else 0.0
    return x * inverse, y * inverse, z * inverse, inverse


@helper
def evaluate_basis(x, y, z, count, basis):
    """Write b_1 .. b_(count - 1) to ``basis`` from entry 1 on; count is 4, 9 or 16."""
    basis[1] = -C1 * y
    basis[2] = C1 * z
    basis[3] = -C1 * x
    if count < 9:
        return
    xx, yy, zz = x * x, y * y, z * z
    basis[4] = C2_XY * x * y
    basis[5] = -C2_XY * y * z
    basis[6] = C2_ZZ * (2 * zz - xx - yy)
    basis[7] = -C2_XY * x * z
    basis[8] = C2_XX_YY * (xx - yy)
    if count < 16:
        return
    basis[9] = -C3_3 * y * (3 * xx - yy)
    basis[10] = C3_2 * x * y * z
    basis[11] = -C3_1 * y * (4 * zz - xx - yy)
    basis[12] = C3_0 * z * (2 * zz - 3 * xx - 3 * yy)
    basis[13] = -C3_1 * x * (4 * zz - xx - yy)
    basis[14] = C3_2_DIFFERENCE * z * (xx - yy)
    basis[15] = -C3_3 * x * (xx - 3 * yy)


@helper
def _differentiate_basis(x, y, z, count, h):
    """Gradient of sum_k h_k b_k by x, y, z as free variables."""
    d_x, d_y, d_z = -C1 * h[3], -C1 * h[1], C1 * h[2]
    if count < 9:
        return d_x, d_y, d_z
    d_x += C2_XY * (y * h[4] - z * h[7]) + 2 * x * (C2_XX_YY * h[8] - C2_ZZ * h[6])
    d_y += C2_XY * (x * h[4] - z * h[5]) - 2 * y * (C2_XX_YY * h[8] + C2_ZZ * h[6])
    d_z += 4 * C2_ZZ * z * h[6] - C2_XY * (y * h[5] + x * h[7])
    if count < 16:
        return d_x, d_y, d_z
    xx, yy, zz = x * x, y * y, z * z
    xy, yz, xz = x * y, y * z, x * z
    d_x += C3_3 * (3 * (yy - xx) * h[15] - 6 * xy * h[9]) + C3_2 * yz * h[10] - 6 * C3_0 * xz * h[12]
    d_x += C3_1 * (2 * xy * h[11] - (4 * zz - 3 * xx - yy) * h[13]) + 2 * C3_2_DIFFERENCE * xz * h[14]
    d_y += C3_3 * (3 * (yy - xx) * h[9] + 6 * xy * h[15]) + C3_2 * xz * h[10] - 6 * C3_0 * yz * h[12]
    d_y += C3_1 * (2 * xy * h[13] - (4 * zz - xx - 3 * yy) * h[11]) - 2 * C3_2_DIFFERENCE * yz * h[14]
    d_z += C3_2 * xy * h[10] + 3 * C3_0 * (2 * zz - xx - yy) * h[12] + C3_2_DIFFERENCE * (xx - yy) * h[14]
    d_z -= 8 * C3_1 * (yz * h[11] + xz * h[13])
    return d_x, d_y, d_z


@helper
def _sum_basis(basis, count, constants, start, rest, rest_start):
    """Three channels of 0.5 + C0 sh_0 + sum_k b_k sh_k, not clamped."""
    first, at = np.uint64(start), np.uint64(rest_start)
    half, c0 = float32(0.5), float32(C0)
    r = half + c0 * constants[first]
    g = half + c0 * constants[first + np.uint64(1)]
    b = half + c0 * constants[first + np.uint64(2)]
    for k in range(1, count):
        r += basis[k] * rest[at]
        g += basis[k] * rest[at + np.uint64(1)]
        b += basis[k] * rest[at + np.uint64(2)]
        at += np.uint64(3)
    return r, g, b


@kernel
def shade(
    worker, workers, means, eyes, view_maps, pose_ids, constants, stride, rest, rest_start, rest_stride, count,
    factor, colors,
):  # fmt: skip
    """Compute the worker's share of the colours.

    Args:
        means: Centres. [N, 3]
        eyes: Eye of each pose, in the frame of the centres. [P, 3] float64
        view_maps: The map A of each pose. [P, 3, 3] float64
        pose_ids: Pose of each Gaussian. [N], or [0] if all have pose 0
        constants: Flat; the degree-0 coefficients of Gaussian i begin at i stride.
        rest: Flat; the others begin at rest_start + i rest_stride.
        count: Coefficients per channel, K: 4, 9 or 16.
        factor: Factor on the colour. [N], or [0] if it is 1
        colors: Result. [N, 3]
    """
    n, zero = len(means), float32(0)
    basis = np.empty(BASES, np.float32)
    for i in range(n * worker // workers, n * (worker + 1) // workers):
        x, y, z, _ = _direction(means, eyes, view_maps, i, pose_ids[i] if len(pose_ids) else 0)
        evaluate_basis(x, y, z, count, basis)
        r, g, b = _sum_basis(basis, count, constants, i * stride, rest, rest_start + i * rest_stride)
        strength = factor[i] if len(factor) else float32(1)
        # Comparisons that let NaN pass.
        colors[i, 0] = (zero if r < zero else r) * strength
        colors[i, 1] = (zero if g < zero else g) * strength
        colors[i, 2] = (zero if b < zero else b) * strength


@kernel
def shade_backward(
    worker, workers, means, eyes, view_maps, pose_ids, constants, stride, rest, rest_start, rest_stride, count,
    factor, d_colors, d_constants, d_rest, d_means, d_factor,
):  # fmt: skip
    """Compute the worker's share of the gradients: of the coefficients, laid out as they are, means and factor.

    Args:
        d_colors: Gradient of the colours. [N, 3]
        d_constants, d_rest: Results, flat; every entry that a stride reaches is written.
        d_means: Result. [N, 3], or [0, 3] to skip it
        d_factor: Result. [N], or [0] to skip it
    """
    n, zero = len(means), float32(0)
    basis, h = np.empty(BASES, np.float32), np.empty(BASES, np.float32)
    c0 = float32(C0)
    for i in range(n * worker // workers, n * (worker + 1) // workers):
        pose = pose_ids[i] if len(pose_ids) else 0
        x, y, z, inverse = _direction(means, eyes, view_maps, i, pose)
        evaluate_basis(x, y, z, count, basis)
        r, g, b = _sum_basis(basis, count, constants, i * stride, rest, rest_start + i * rest_stride)
        d_r, d_g, d_b = d_colors[i, 0], d_colors[i, 1], d_colors[i, 2]
        d_r, d_g, d_b = zero if r < zero else d_r, zero if g < zero else d_g, zero if b < zero else d_b
        if len(d_factor):
            d_factor[i] = d_r * r + d_g * g + d_b * b
        if len(factor):
            d_r, d_g, d_b = d_r * factor[i], d_g * factor[i], d_b * factor[i]
        first, at = np.uint64(i * stride), np.uint64(rest_start + i * rest_stride)
        d_constants[first] = c0 * d_r
        d_constants[first + np.uint64(1)] = c0 * d_g
        d_constants[first + np.uint64(2)] = c0 * d_b
        for k in range(1, count):
            h[k] = d_r * rest[at] + d_g * rest[at + np.uint64(1)] + d_b * rest[at + np.uint64(2)]
            d_rest[at] = basis[k] * d_r
            d_rest[at + np.uint64(1)] = basis[k] * d_g
            d_rest[at + np.uint64(2)] = basis[k] * d_b
            at += np.uint64(3)
        if len(d_means) == 0:
            continue
        # Through d = v / |v|: remove the component along d; then through v = A (mean - eye).
        d_x, d_y, d_z = _differentiate_basis(x, y, z, count, h)
        along = x * d_x + y * d_y + z * d_z
        d_x, d_y, d_z = (d_x - along * x) * inverse, (d_y - along * y) * inverse, (d_z - along * z) * inverse
        for k in range(3):
            d_means[i, k] = view_maps[pose, 0, k] * d_x + view_maps[pose, 1, k] * d_y + view_maps[pose, 2, k] * d_z
