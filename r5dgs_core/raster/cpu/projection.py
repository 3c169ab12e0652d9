"""Kernels for projecting Gaussians to the image and for the gradients, eight Gaussians at a time in float64.

Notation: p = (x, y, z) centre in the camera frame, u = x / z and v = y / z slopes, W world to camera rotation, R
rotation of the Gaussian, M = W R diag(s), J Jacobian of the projection, P = J M, C = P P^T + dilation.

The conic C^-1 is stored as L^T L with L = [[l11, -l12], [0, l22]]. The exponent is then a sum of two squares, which
avoids the float32 cancellation of the expanded quadratic form for long thin Gaussians.
"""

from __future__ import annotations

import math

import numpy as np

from ..compilation import helper, kernel
from .simd.float32x16 import LANES, load
from .simd.float64x8 import (
    DOUBLES,
    column,
    entry,
    floor,
    log2,
    set_column,
    spread,
    sqrt,
    store_doubles,
    store_table,
    widen,
)
from .simd.vectors import any_of, larger, select, smaller

# Columns of the geometry table, one row per Gaussian: centre in px; whitening L, scaled so that
# log2(alpha) = LOG2_OPACITY - (l11 dx - l12 dy)^2 - (l22 dy)^2; half extents of the alpha_min ellipse in px.
MEAN_X, MEAN_Y, L11, L12, L22, LOG2_OPACITY, EXTENT_X, EXTENT_Y = range(8)
GEOMETRY = 8

# Entries of the view vector, see `forward.pack_view`.
FX, SKEW, CX, FY, CY, U_LOW, U_HIGH, V_LOW, V_HIGH, WIDTH, HEIGHT, NEAR, DILATION, ALPHA_MIN = range(14)
ROTATION, TRANSLATION = 14, 23

# Tiles of the image: side in px, and maximum number per side, so that four tile indices fit into one float64.
TILE = 32  # larger tiles make fewer pairs; smaller ones finish earlier in opaque scenes
MAX_TILES = 8191
BOX_DIGIT = MAX_TILES + 1
BOX_MARGIN = 0.01  # px added to the extents, far above rounding; exact decisions come later

# A slot begins with sums over pixels of A, A u, A v, A u u, A u v, A v v with A = dL/d(ln alpha) and (u, v) = L d
# scaled as above. Then come the gradients of four values, zeros up to a whole vector, and gradients of further values.
MOMENTS = 6

_WHITEN = 0.5 / math.log(2.0)  # ratio of the scaled (u, v) squared to L d squared
_UNWHITEN, _UNWHITEN_ROOT = 1 / _WHITEN, 1 / math.sqrt(_WHITEN)
_TWICE_LN_2 = 2 * math.log(2.0)


def padded_rows(n: int) -> int:
    """Number of rows of the tables that the kernels of this module write for n Gaussians."""
    return -(-n // DOUBLES) * DOUBLES


@helper
def _linearise(u, v, inverse_z, view):
    """Jacobian of the projection at slopes u, v: j00, j01, j02, j11, j12; and the clamped slopes."""
    u = smaller(larger(u, entry(view, U_LOW)), entry(view, U_HIGH))
    v = smaller(larger(v, entry(view, V_LOW)), entry(view, V_HIGH))
    j00, j01, j11 = entry(view, FX) * inverse_z, entry(view, SKEW) * inverse_z, entry(view, FY) * inverse_z
    return j00, j01, -(j00 * u + j01 * v), j11, -(j11 * v), u, v


@helper
def _rotation(view):
    """Entries of W, row by row."""
    r = ROTATION
    return (
        entry(view, r), entry(view, r + 1), entry(view, r + 2), entry(view, r + 3), entry(view, r + 4),
        entry(view, r + 5), entry(view, r + 6), entry(view, r + 7), entry(view, r + 8),
    )  # fmt: skip


@helper
def _product(a, b):
    """Matrix product a b, row by row."""
    return (
        a[0] * b[0] + a[1] * b[3] + a[2] * b[6],
        a[0] * b[1] + a[1] * b[4] + a[2] * b[7],
        a[0] * b[2] + a[1] * b[5] + a[2] * b[8],
        a[3] * b[0] + a[4] * b[3] + a[5] * b[6],
        a[3] * b[1] + a[4] * b[4] + a[5] * b[7],
        a[3] * b[2] + a[4] * b[5] + a[5] * b[8],
        a[6] * b[0] + a[7] * b[3] + a[8] * b[6],
        a[6] * b[1] + a[7] * b[4] + a[8] * b[7],
        a[6] * b[2] + a[7] * b[5] + a[8] * b[8],
    )


@helper
def _rotate(view, w, x, y, z):
    """W R(q) for unit quaternions, row by row."""
    one, two = spread(1.0), spread(2.0)
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz, wx, wy, wz = x * y, x * z, y * z, w * x, w * y, w * z
    local = (
        one - two * (yy + zz), two * (xy - wz), two * (xz + wy),
        two * (xy + wz), one - two * (xx + zz), two * (yz - wx),
        two * (xz - wy), two * (yz + wx), one - two * (xx + yy),
    )  # fmt: skip
    return _product(_rotation(view), local)


@helper
def _to_camera(view, a, b, c):
    """Transform world points (a, b, c) to the camera frame."""
    k = _rotation(view)
    return (
        entry(view, TRANSLATION) + k[0] * a + k[1] * b + k[2] * c,
        entry(view, TRANSLATION + 1) + k[3] * a + k[4] * b + k[5] * c,
        entry(view, TRANSLATION + 2) + k[6] * a + k[7] * b + k[8] * c,
    )


@helper
def _unit(quats, i, last):
    """Normalised quaternions i to i + 7, and the inverses of their lengths; zero gives the identity and inverse 0."""
    zero, one = spread(0.0), spread(1.0)
    w, x, y, z = (
        column(quats, i, last, 4, 0), column(quats, i, last, 4, 1),
        column(quats, i, last, 4, 2), column(quats, i, last, 4, 3),
    )  # fmt: skip
    square = w * w + x * x + y * y + z * z
    proper = square > zero
    inverse = select(proper, one / sqrt(select(proper, square, one)), zero)
    return select(proper, w * inverse, one), x * inverse, y * inverse, z * inverse, inverse


@helper
def _axes(j, r, s0, s1, s2):
    """P = J (W R) diag(s), row by row."""
    j00, j01, j02, j11, j12 = j[0], j[1], j[2], j[3], j[4]
    return (
        (j00 * r[0] + j01 * r[3] + j02 * r[6]) * s0,
        (j00 * r[1] + j01 * r[4] + j02 * r[7]) * s1,
        (j00 * r[2] + j01 * r[5] + j02 * r[8]) * s2,
        (j11 * r[3] + j12 * r[6]) * s0,
        (j11 * r[4] + j12 * r[7]) * s1,
        (j11 * r[5] + j12 * r[8]) * s2,
    )


@helper
def _covariance(p, dilation):
    """Return c_xx, c_xy, c_yy of P P^T with dilation, and the determinant.

    det(P P^T + d I) = det(P P^T) + d tr(P P^T) + d^2, and det(P P^T) is the sum of the squared minors of P
    (Cauchy-Binet), so nothing cancels for long thin Gaussians.
    """
    xx = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
    xy = p[0] * p[3] + p[1] * p[4] + p[2] * p[5]
    yy = p[3] * p[3] + p[4] * p[4] + p[5] * p[5]
    minor_01, minor_02, minor_12 = p[0] * p[4] - p[1] * p[3], p[0] * p[5] - p[2] * p[3], p[1] * p[5] - p[2] * p[4]
    determinant = minor_01 * minor_01 + minor_02 * minor_02 + minor_12 * minor_12 + dilation * (xx + yy + dilation)
    return xx + dilation, xy, yy + dilation, determinant


@helper
def _tiles(low, high, count):
    """First and one past the last of ``count`` tiles with pixel centres between two coordinates in px."""
    zero, side, half = spread(0.0), spread(1.0 * TILE), spread(0.5)
    first = larger(floor((larger(low, zero) - half) / side), zero)
    end = smaller(floor((smaller(high, count * side) - half) / side) + spread(1.0), count)
    return first, larger(end, first)


@kernel
def project(worker, workers, view, means, quats, scales, opacities, geometry, depths, boxes, radii):
    """Project the worker's share of the Gaussians.

    The inputs are flat. The results have n = `padded_rows` rows; padding rows have radius 0.

    Args:
        geometry: Projected Gaussians. [n, 8]
        depths: z in the camera frame. [n]
        boxes: Tiles of the bounding box, four digits to the base `BOX_DIGIT` in one number, most significant first: one
            past the last row, first row, one past the last column, first column. [n] float64
        radii: Three standard deviations along the long axis, px, 0 if the image is not touched. [n]
    """
    count = len(opacities)
    last, blocks = count - 1, len(depths) // DOUBLES
    flat = geometry.reshape(-1)
    zero, one = spread(0.0), spread(1.0)
    near, alpha_min, dilation = entry(view, NEAR), entry(view, ALPHA_MIN), entry(view, DILATION)
    log2_alpha_min, width, height = log2(alpha_min), entry(view, WIDTH), entry(view, HEIGHT)
    whiten, half, margin, digit = spread(_WHITEN), spread(0.5), spread(BOX_MARGIN), spread(1.0 * BOX_DIGIT)
    columns, rows = spread(1.0 * ((view[WIDTH] + TILE - 1) // TILE)), spread(1.0 * ((view[HEIGHT] + TILE - 1) // TILE))
    for block in range(blocks * worker // workers, blocks * (worker + 1) // workers):
        i = block * DOUBLES
        opacity = column(opacities, i, last, 1, 0)
        a, b, c = column(means, i, last, 3, 0), column(means, i, last, 3, 1), column(means, i, last, 3, 2)
        x, y, z = _to_camera(view, a, b, c)
        seen = (opacity >= alpha_min) & (z > near)
        if not any_of(seen):
            set_column(radii, i, 1, 0, zero)
            store_doubles(depths, i, one)
            continue
        z = select(seen, z, one)
        inverse_z = one / z
        u, v = x / z, y / z
        mean_x = entry(view, FX) * u + entry(view, SKEW) * v + entry(view, CX)
        mean_y = entry(view, FY) * v + entry(view, CY)
        w, qx, qy, qz, _ = _unit(quats, i, last)
        j = _linearise(u, v, inverse_z, view)
        s0, s1, s2 = column(scales, i, last, 3, 0), column(scales, i, last, 3, 1), column(scales, i, last, 3, 2)
        p = _axes(j, _rotate(view, w, qx, qy, qz), s0, s1, s2)
        xx, xy, yy, determinant = _covariance(p, dilation)
        log2_opacity = log2(select(seen, opacity, one))
        reach = spread(_TWICE_LN_2) * larger(log2_opacity - log2_alpha_min, zero)
        extent_x, extent_y = sqrt(reach * xx), sqrt(reach * yy)
        seen = seen & (mean_x + extent_x > zero) & (width > mean_x - extent_x)
        seen = seen & (mean_y + extent_y > zero) & (height > mean_y - extent_y)
        l11 = sqrt(whiten * yy / determinant)
        store_table(flat, i, (mean_x, mean_y, l11, l11 * xy / yy, sqrt(whiten / yy), log2_opacity, extent_x, extent_y))
        store_doubles(depths, i, z)
        left, right = _tiles(mean_x - extent_x - margin, mean_x + extent_x + margin, columns)
        top, bottom = _tiles(mean_y - extent_y - margin, mean_y + extent_y + margin, rows)
        store_doubles(boxes, i, ((bottom * digit + top) * digit + right) * digit + left)
        middle, across = half * (xx + yy), half * (xx - yy)
        radius = spread(3.0) * sqrt(middle + sqrt(across * across + xy * xy))
        set_column(radii, i, 1, 0, select(seen, radius, zero))
        for k in range(max(count - i, 0), DOUBLES):
            radii[i + k] = 0


def slot_width(n_channels: int) -> int:
    """Number of columns of a slot."""
    return LANES * (1 + max(0, -(-(n_channels - 3) // LANES)))


@helper
def slot_place(value):
    """Column of the gradient of a value in a slot."""
    return MOMENTS + value if value < 4 else LANES + value - 4


@helper
def _sum_slots(i, count, slot_starts, flat_slots, filled, width, sums):
    """Sum the filled slots of Gaussians i to i + 7 into the rows of ``sums``; return a bit set of those with any."""
    present = np.uint64(0)
    for k in range(min(DOUBLES, count - i)):
        begin, end = slot_starts[i + k], slot_starts[i + k + 1]
        while begin < end and not filled[begin]:
            begin += 1
        if begin == end:
            continue
        present |= np.uint64(1) << np.uint64(k)
        for c in range(0, width, LANES):
            low, high = widen(load(flat_slots, begin * width + c))
            for slot in range(begin + 1, end):
                if filled[slot]:
                    more_low, more_high = widen(load(flat_slots, slot * width + c))
                    low, high = low + more_low, high + more_high
            store_doubles(sums, k * width + c, low)
            store_doubles(sums, k * width + c + DOUBLES, high)
    return present


@kernel
def project_backward(
    worker, workers, view, means, quats, scales, opacities, slot_starts, slots, filled, with_geometry, n_channels,
    d_means, d_quats, d_scales, d_opacities, d_channels, grad_norm,
):  # fmt: skip
    """Sum the slots of each Gaussian and write its gradients; rows of Gaussians without pairs stay zero.

    Args:
        view: See `forward.pack_view`. [26]
        means, quats, scales, opacities: The inputs, flat.
        slot_starts: Slots of Gaussian i are slot_starts[i] : slot_starts[i + 1]. [N + 1]
        slots, filled: Moments and gradients of the values of each pair of Gaussian and tile, and the mask of slots that
            were written. [S, 16 k], [S]
        with_geometry: True if more than the channels need gradients.
        n_channels: D.
        d_means, d_quats, d_scales, d_opacities, d_channels: Gradients, flat, initially zero, with `padded_rows` rows.
        grad_norm: Norm of the gradient by the projected centre in px, initially zero and padded, too.
    """
    count, width = len(opacities), slots.shape[1]
    last, blocks = count - 1, len(grad_norm) // DOUBLES
    sums, flat_slots = np.zeros(DOUBLES * width), slots.reshape(-1)
    end, depth_at = DOUBLES - 1, slot_place(n_channels)
    zero, one, two = spread(0.0), spread(1.0), spread(2.0)
    dilation = entry(view, DILATION)
    for block in range(blocks * worker // workers, blocks * (worker + 1) // workers):
        i = block * DOUBLES
        present = _sum_slots(i, count, slot_starts, flat_slots, filled, width, sums)
        if not present:
            continue
        for k in range(DOUBLES):
            if present >> np.uint64(k) & np.uint64(1):
                for c in range(n_channels):
                    d_channels[(i + k) * n_channels + c] = sums[k * width + slot_place(c)]
            else:
                for c in range(width):
                    sums[k * width + c] = 0
        if not with_geometry:
            continue
        opacity = column(opacities, i, last, 1, 0)
        drawn = opacity > zero
        opacity = select(drawn, opacity, one)
        set_column(d_opacities, i, 1, 0, column(sums, 0, end, width, 0) / opacity)

        a, b, c = column(means, i, last, 3, 0), column(means, i, last, 3, 1), column(means, i, last, 3, 2)
        x, y, z = _to_camera(view, a, b, c)
        z = select(z > entry(view, NEAR), z, one)
        w, qx, qy, qz, inverse_length = _unit(quats, i, last)
        r = _rotate(view, w, qx, qy, qz)
        inverse_z = one / z
        u, v = x / z, y / z
        j = _linearise(u, v, inverse_z, view)
        j00, j01, j02, j11, j12, u_clamped, v_clamped = j
        s = column(scales, i, last, 3, 0), column(scales, i, last, 3, 1), column(scales, i, last, 3, 2)
        p = _axes(j, r, s[0], s[1], s[2])
        xx, xy, yy, determinant = _covariance(p, dilation)
        l11, l22, shift = sqrt(yy / determinant), sqrt(one / yy), xy / yy

        # Gradient by the centre: L^T (sum A u, sum A v).
        root, square = spread(_UNWHITEN_ROOT), spread(_UNWHITEN)
        su, sv = column(sums, 0, end, width, 1) * root, column(sums, 0, end, width, 2) * root
        suu, suv = column(sums, 0, end, width, 3) * square, column(sums, 0, end, width, 4) * square
        svv = column(sums, 0, end, width, 5) * square
        d_x2d = l11 * su
        d_y2d = l22 * sv - shift * d_x2d
        set_column(grad_norm, i, 1, 0, sqrt(d_x2d * d_x2d + d_y2d * d_y2d))

        # C = P P^T, P = J M, M = W R diag(s). dL/dP = L^T S L P with S the second moments. L P is computed from the
        # minors of P, because the expanded L^T S L cancels for thin Gaussians. d_m is dL/dM, row by row.
        d_a, d_b = _to_axes(p, (suu, suv, svv), l11, l22, shift, one / yy, dilation)
        d_m = (
            j00 * d_a[0], j00 * d_a[1], j00 * d_a[2],
            j01 * d_a[0] + j11 * d_b[0], j01 * d_a[1] + j11 * d_b[1], j01 * d_a[2] + j11 * d_b[2],
            j02 * d_a[0] + j12 * d_b[0], j02 * d_a[1] + j12 * d_b[1], j02 * d_a[2] + j12 * d_b[2],
        )  # fmt: skip
        set_column(d_scales, i, 3, 0, d_m[0] * r[0] + d_m[3] * r[3] + d_m[6] * r[6])
        set_column(d_scales, i, 3, 1, d_m[1] * r[1] + d_m[4] * r[4] + d_m[7] * r[7])
        set_column(d_scales, i, 3, 2, d_m[2] * r[2] + d_m[5] * r[5] + d_m[8] * r[8])
        a0, a1, a2 = d_a[0] * s[0], d_a[1] * s[1], d_a[2] * s[2]
        b0, b1, b2 = d_b[0] * s[0], d_b[1] * s[1], d_b[2] * s[2]
        d_j00 = a0 * r[0] + a1 * r[1] + a2 * r[2]
        d_j01 = a0 * r[3] + a1 * r[4] + a2 * r[5]
        d_j02 = a0 * r[6] + a1 * r[7] + a2 * r[8]
        d_j11 = b0 * r[3] + b1 * r[4] + b2 * r[5]
        d_j12 = b0 * r[6] + b1 * r[7] + b2 * r[8]

        d_z = column(sums, 0, end, width, depth_at)
        d_z = d_z - (j00 * d_j00 + j01 * d_j01 + j02 * d_j02 + j11 * d_j11 + j12 * d_j12) * inverse_z
        d_x, d_y = j00 * d_x2d, j01 * d_x2d + j11 * d_y2d  # d_u / z and d_v / z
        inside_u, inside_v = (u >= u_clamped) & (u_clamped >= u), (v >= v_clamped) & (v_clamped >= v)
        d_x = select(inside_u, d_x - j00 * d_j02 * inverse_z, d_x)
        d_y = select(inside_v, d_y - (j01 * d_j02 + j11 * d_j12) * inverse_z, d_y)
        d_z = d_z - (d_x * u + d_y * v)
        t = _rotation(view)
        set_column(d_means, i, 3, 0, t[0] * d_x + t[3] * d_y + t[6] * d_z)
        set_column(d_means, i, 3, 1, t[1] * d_x + t[4] * d_y + t[7] * d_z)
        set_column(d_means, i, 3, 2, t[2] * d_x + t[5] * d_y + t[8] * d_z)

        # R = W^T (W R); then through the normalisation of the quaternion.
        turned = _product((t[0], t[3], t[6], t[1], t[4], t[7], t[2], t[5], t[8]), d_m)
        r00, r01, r02 = turned[0] * s[0], turned[1] * s[1], turned[2] * s[2]
        r10, r11, r12 = turned[3] * s[0], turned[4] * s[1], turned[5] * s[2]
        r20, r21, r22 = turned[6] * s[0], turned[7] * s[1], turned[8] * s[2]
        d_w = two * (qx * (r21 - r12) + qy * (r02 - r20) + qz * (r10 - r01))
        d_qx = two * (qy * (r01 + r10) + qz * (r02 + r20) + w * (r21 - r12) - two * qx * (r11 + r22))
        d_qy = two * (qx * (r01 + r10) + qz * (r12 + r21) + w * (r02 - r20) - two * qy * (r00 + r22))
        d_qz = two * (qx * (r02 + r20) + qy * (r12 + r21) + w * (r10 - r01) - two * qz * (r00 + r11))
        along = w * d_w + qx * d_qx + qy * d_qy + qz * d_qz
        set_column(d_quats, i, 4, 0, (d_w - along * w) * inverse_length)
        set_column(d_quats, i, 4, 1, (d_qx - along * qx) * inverse_length)
        set_column(d_quats, i, 4, 2, (d_qy - along * qy) * inverse_length)
        set_column(d_quats, i, 4, 3, (d_qz - along * qz) * inverse_length)


@helper
def _to_axes(p, sums, l11, l22, shift, inverse_yy, dilation):
    """L^T S L P, row by row, with S = ((suu, suv), (suv, svv))."""
    a0, a1, a2, b0, b1, b2 = p
    suu, suv, svv = sums
    m01, m02, m12 = a0 * b1 - a1 * b0, a0 * b2 - a2 * b0, a1 * b2 - a2 * b1
    scale = l11 * inverse_yy
    w0 = scale * (dilation * a0 + b1 * m01 + b2 * m02)
    w1 = scale * (dilation * a1 - b0 * m01 + b2 * m12)
    w2 = scale * (dilation * a2 - b0 * m02 - b1 * m12)
    z0, z1, z2 = l22 * b0, l22 * b1, l22 * b2
    d_a = l11 * (suu * w0 + suv * z0), l11 * (suu * w1 + suv * z1), l11 * (suu * w2 + suv * z2)
    d_b = (
        l22 * (suv * w0 + svv * z0) - shift * d_a[0],
        l22 * (suv * w1 + svv * z1) - shift * d_a[1],
        l22 * (suv * w2 + svv * z2) - shift * d_a[2],
    )
    return d_a, d_b
