"""Kernels that project Gaussians to the image and bring their gradients back, in float64 per Gaussian.

Notation: p = (x, y, z) centre in the camera frame, u = x / z and v = y / z slopes, W world to camera rotation, R of the
Gaussian, M = W R diag(s), J Jacobian of the projection, P = J M, C = P P^T + dilation.

The conic C^-1 is kept as L^T L with L = [[l11, -l12], [0, l22]]: the exponent is then a sum of two squares, which does
not cancel for long thin Gaussians as the expanded quadratic form does in float32.
"""

from __future__ import annotations

import math

import numpy as np

from .compile import kernel
from .lanes import LANES

# Columns of the geometry table. Row of each Gaussian: centre in px; the whitening L scaled so that
# log2(alpha) = LOG2_OPACITY - (l11 dx - l12 dy)^2 - (l22 dy)^2; half extents of the alpha_min ellipse in px.
MEAN_X, MEAN_Y, L11, L12, L22, LOG2_OPACITY, EXTENT_X, EXTENT_Y = range(8)
GEOMETRY = 8

# Entries of the view vector, see `cpu.pack_view`.
FX, SKEW, CX, FY, CY, U_LOW, U_HIGH, V_LOW, V_HIGH, WIDTH, HEIGHT, NEAR, DILATION, ALPHA_MIN = range(14)
ROTATION, TRANSLATION = 14, 23
VIEW = 26

# A slot begins with sums over pixels of A, A u, A v, A u u, A u v, A v v with A = dL/d(ln alpha) and (u, v) = L d
# scaled as above; then come the gradients of four values, zeros to a whole vector, and the gradients of further values.
MOMENTS = 6

_WHITEN = 0.5 / math.log(2.0)  # squares of the scaled (u, v) are this times those of L d
_UNWHITEN, _UNWHITEN_ROOT = 1 / _WHITEN, 1 / math.sqrt(_WHITEN)


@kernel
def _linearise(u, v, inverse_z, view):
    """The Jacobian of the projection at slopes u, v: j00, j01, j02, j11, j12; and the clamped slopes."""
    u = min(max(u, view[U_LOW]), view[U_HIGH])
    v = min(max(v, view[V_LOW]), view[V_HIGH])
    j00, j01, j11 = view[FX] * inverse_z, view[SKEW] * inverse_z, view[FY] * inverse_z
    return j00, j01, -(j00 * u + j01 * v), j11, -j11 * v, u, v


@kernel
def _rotate(view, w, x, y, z, rotation):
    """Write W R(q) for a unit quaternion to a flat array of nine."""
    local = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    for i in range(3):
        a, b, c = view[ROTATION + 3 * i], view[ROTATION + 3 * i + 1], view[ROTATION + 3 * i + 2]
        for k in range(3):
            rotation[3 * i + k] = a * local[0][k] + b * local[1][k] + c * local[2][k]


@kernel
def _to_camera(view, means, i):
    """Centre i in the camera frame."""
    a, b, c = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
    x = view[TRANSLATION] + view[ROTATION] * a + view[ROTATION + 1] * b + view[ROTATION + 2] * c
    y = view[TRANSLATION + 1] + view[ROTATION + 3] * a + view[ROTATION + 4] * b + view[ROTATION + 5] * c
    z = view[TRANSLATION + 2] + view[ROTATION + 6] * a + view[ROTATION + 7] * b + view[ROTATION + 8] * c
    return x, y, z


@kernel
def _unit(quats, i):
    """Quaternion i made one long, and one over its length; the zero quaternion counts as no rotation, with 0."""
    w, x, y, z = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
    square = w * w + x * x + y * y + z * z
    if square == 0:
        return 1.0, 0.0, 0.0, 0.0, 0.0
    inverse = 1 / math.sqrt(square)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@kernel
def _covariance(j00, j01, j02, j11, j12, rotation, scales, i, dilation, axes):
    """Write P (2 x 3, flat) and return c_xx, c_xy, c_yy with dilation, and the determinant.

    det(P P^T + d I) = det(P P^T) + d tr(P P^T) + d^2, and det(P P^T) is the sum of the squared minors of P (Cauchy and
    Binet): nothing cancels, however long and thin the Gaussian is.
    """
    xx, xy, yy = 0.0, 0.0, 0.0
    for k in range(3):
        a = (j00 * rotation[k] + j01 * rotation[3 + k] + j02 * rotation[6 + k]) * np.float64(scales[i, k])
        b = (j11 * rotation[3 + k] + j12 * rotation[6 + k]) * np.float64(scales[i, k])
        axes[k], axes[3 + k] = a, b
        xx += a * a
        xy += a * b
        yy += b * b
    minor_01 = axes[0] * axes[4] - axes[1] * axes[3]
    minor_02 = axes[0] * axes[5] - axes[2] * axes[3]
    minor_12 = axes[1] * axes[5] - axes[2] * axes[4]
    determinant = minor_01 * minor_01 + minor_02 * minor_02 + minor_12 * minor_12 + dilation * (xx + yy + dilation)
    return xx + dilation, xy, yy + dilation, determinant


@kernel
def project(worker, workers, view, means, quats, scales, opacities, geometry, depths, radii):
    """Fill the rows of this worker: geometry [N, 8], depths [N] and radii [N] (0 where the image is not touched)."""
    n = len(means)
    rotation, axes = np.empty(9), np.empty(6)
    for i in range(n * worker // workers, n * (worker + 1) // workers):
        radii[i] = 0
        opacity = np.float64(opacities[i])
        if opacity < view[ALPHA_MIN]:
            continue
        x, y, z = _to_camera(view, means, i)
        if z <= view[NEAR]:
            continue
        w, qx, qy, qz, _ = _unit(quats, i)
        _rotate(view, w, qx, qy, qz, rotation)
        u, v = x / z, y / z
        j00, j01, j02, j11, j12, _, _ = _linearise(u, v, 1 / z, view)
        xx, xy, yy, determinant = _covariance(j00, j01, j02, j11, j12, rotation, scales, i, view[DILATION], axes)
        mean_x = view[FX] * u + view[SKEW] * v + view[CX]
        mean_y = view[FY] * v + view[CY]
        reach = 2 * math.log(opacity / view[ALPHA_MIN])
        extent_x, extent_y = math.sqrt(reach * xx), math.sqrt(reach * yy)
        if not (
            mean_x + extent_x > 0
            and mean_x - extent_x < view[WIDTH]
            and mean_y + extent_y > 0
            and mean_y - extent_y < view[HEIGHT]
        ):
            continue
        geometry[i, MEAN_X] = mean_x
        geometry[i, MEAN_Y] = mean_y
        geometry[i, L11] = math.sqrt(_WHITEN * yy / determinant)
        geometry[i, L12] = geometry[i, L11] * xy / yy
        geometry[i, L22] = math.sqrt(_WHITEN / yy)
        geometry[i, LOG2_OPACITY] = math.log2(opacity)
        geometry[i, EXTENT_X] = extent_x
        geometry[i, EXTENT_Y] = extent_y
        depths[i] = z
        middle, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
        radii[i] = 3 * math.sqrt(middle + math.sqrt(half * half + xy * xy))


def slot_width(n_channels: int) -> int:
    """Number of columns of a slot."""
    return LANES * (1 + max(0, -(-(n_channels - 3) // LANES)))


@kernel
def slot_place(value):
    """Column of the gradient of a value in a slot."""
    return MOMENTS + value if value < 4 else LANES + value - 4


@kernel
def project_backward(
    worker, workers, view, means, quats, scales, opacities, slot_starts, slots, with_geometry, d_means, d_quats,
    d_scales, d_opacities, d_channels, grad_norm,
):  # fmt: skip
    """Sum the pair slots of each Gaussian and write its gradients; rows of Gaussians without pairs stay as they are.

    Args:
        view: See `cpu.pack_view`. [26]
        means, quats, scales, opacities: The inputs, one row per Gaussian.
        slot_starts: Slots of Gaussian i are slot_starts[i] : slot_starts[i + 1]. [N + 1]
        slots: Moments and gradients of the values of each pair of Gaussian and tile. [S, 16 k]
        with_geometry: Whether more than channels want a gradient.
        d_means, d_quats, d_scales, d_opacities, d_channels: Gradients. [N, ...]
        grad_norm: Norm of the gradient with respect to the projected centre in px. [N]
    """
    n, n_channels = d_channels.shape
    width = slots.shape[1]
    sums, rotation, axes = np.empty(width), np.empty(9), np.empty(6)
    d_axes, d_m, d_r = np.empty(6), np.empty(9), np.empty(9)
    for i in range(n * worker // workers, n * (worker + 1) // workers):
        if slot_starts[i] == slot_starts[i + 1]:
            continue
        sums[:] = 0
        for slot in range(slot_starts[i], slot_starts[i + 1]):
            for c in range(width):
                sums[c] += slots[slot, c]
        for c in range(n_channels):
            d_channels[i, c] = sums[slot_place(c)]
        if not with_geometry:
            continue
        d_opacities[i] = sums[0] / opacities[i]

        x, y, z = _to_camera(view, means, i)
        w, qx, qy, qz, inverse_length = _unit(quats, i)
        _rotate(view, w, qx, qy, qz, rotation)
        inverse_z = 1 / z
        u, v = x * inverse_z, y * inverse_z
        j00, j01, j02, j11, j12, u_clamped, v_clamped = _linearise(u, v, inverse_z, view)
        xx, xy, yy, determinant = _covariance(j00, j01, j02, j11, j12, rotation, scales, i, view[DILATION], axes)
        l11, l22, shift = math.sqrt(yy / determinant), math.sqrt(1 / yy), xy / yy

        # To the centre: L^T (sum A u, sum A v). To the covariance: L^T (sums of squares) L / 2.
        su, sv = sums[1] * _UNWHITEN_ROOT, sums[2] * _UNWHITEN_ROOT
        suu, suv, svv = sums[3] * _UNWHITEN, sums[4] * _UNWHITEN, sums[5] * _UNWHITEN
        d_x2d = l11 * su
        d_y2d = l22 * sv - shift * d_x2d
        grad_norm[i] = math.sqrt(d_x2d * d_x2d + d_y2d * d_y2d)
        g_xx = 0.5 * l11 * l11 * suu
        g_xy = 0.5 * l11 * l22 * suv - shift * g_xx
        g_yy = 0.5 * l22 * l22 * svv - shift * l11 * l22 * suv + shift * shift * g_xx

        # C = P P^T, P = J M, M = W R diag(s)
        d_j00, d_j01, d_j02, d_j11, d_j12 = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(3):
            d_a = 2 * (g_xx * axes[k] + g_xy * axes[3 + k])
            d_b = 2 * (g_xy * axes[k] + g_yy * axes[3 + k])
            r0, r1, r2, s = rotation[k], rotation[3 + k], rotation[6 + k], np.float64(scales[i, k])
            d_m[k], d_m[3 + k], d_m[6 + k] = j00 * d_a, j01 * d_a + j11 * d_b, j02 * d_a + j12 * d_b
            d_scales[i, k] = d_m[k] * r0 + d_m[3 + k] * r1 + d_m[6 + k] * r2
            d_j00 += d_a * r0 * s
            d_j01 += d_a * r1 * s
            d_j02 += d_a * r2 * s
            d_j11 += d_b * r1 * s
            d_j12 += d_b * r2 * s
            d_axes[k] = s

        d_z = sums[slot_place(n_channels)]  # the depth follows the channels
        d_z -= (j00 * d_j00 + j01 * d_j01 + j02 * d_j02 + j11 * d_j11 + j12 * d_j12) * inverse_z
        d_x, d_y = j00 * d_x2d, j01 * d_x2d + j11 * d_y2d  # d_u / z and d_v / z
        if u == u_clamped:
            d_x -= j00 * d_j02 * inverse_z
        if v == v_clamped:
            d_y -= (j01 * d_j02 + j11 * d_j12) * inverse_z
        d_z -= d_x * u + d_y * v
        for k in range(3):
            d_means[i, k] = view[ROTATION + k] * d_x + view[ROTATION + 3 + k] * d_y + view[ROTATION + 6 + k] * d_z

        # R = W^T (W R); then through the normalisation of the quaternion.
        for row in range(3):
            for k in range(3):
                d_r[3 * row + k] = d_axes[k] * (
                    view[ROTATION + row] * d_m[k]
                    + view[ROTATION + 3 + row] * d_m[3 + k]
                    + view[ROTATION + 6 + row] * d_m[6 + k]
                )
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = (
            d_r[0], d_r[1], d_r[2], d_r[3], d_r[4], d_r[5], d_r[6], d_r[7], d_r[8]
        )  # fmt: skip
        d_w = 2 * (qx * (r21 - r12) + qy * (r02 - r20) + qz * (r10 - r01))
        d_qx = 2 * (qy * (r01 + r10) + qz * (r02 + r20) + w * (r21 - r12) - 2 * qx * (r11 + r22))
        d_qy = 2 * (qx * (r01 + r10) + qz * (r12 + r21) + w * (r02 - r20) - 2 * qy * (r00 + r22))
        d_qz = 2 * (qx * (r02 + r20) + qy * (r12 + r21) + w * (r10 - r01) - 2 * qz * (r00 + r11))
        along = w * d_w + qx * d_qx + qy * d_qy + qz * d_qz
        d_quats[i, 0] = (d_w - along * w) * inverse_length
        d_quats[i, 1] = (d_qx - along * qx) * inverse_length
        d_quats[i, 2] = (d_qy - along * qy) * inverse_length
        d_quats[i, 3] = (d_qz - along * qz) * inverse_length
