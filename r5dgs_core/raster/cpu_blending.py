"""Kernels that blend the pairs of each tile, and take the gradient of that.

A tile is 16 x 16 px, worked on in strips of eight pixels of one row (`lanes`). Tile buffers are ordered by half, row and
column, so that a strip is contiguous: offset ((half * 16 + row) * 8). Channels come in fours: the D channels, then depth,
then zeros. A finished pixel keeps its transmittance T with the sign turned.
"""

from __future__ import annotations

import numpy as np
from numba import float32

from .compile import kernel
from .cpu_projection import EXTENT_X, EXTENT_Y, L11, L22, LOG2_OPACITY, MEAN_X, MEAN_Y, MOMENTS, SHIFT
from .cpu_tiles import TILE
from .lanes import LANES, any_of, exp2, fma, iota, load, select, smaller, splat, store, total

PIXELS = TILE * TILE
HALVES = TILE // LANES

# Entries of the limits vector (float32).
LOG2_ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN, ID_ALPHA_MIN = range(4)


@kernel
def _span(center, extent, origin, size):
    """First and last index of the pixel centres within ``extent`` of ``center``, counted from ``origin``, in 0 .. size - 1."""
    first = np.ceil(max(center - extent - origin - float32(0.51), float32(0)))
    last = np.floor(min(center + extent - origin - float32(0.49), float32(size - 1)))
    return int(first), int(last)


@kernel
def blend(
    worker, workers, tile_starts, pair_ranks, geometry, values, labels, planes, background, limits, image, alpha, depth,
    transmittance, ids, tile_ends,
):  # fmt: skip
    """Blend every workers-th tile.

    Args:
        tile_starts, pair_ranks: Pairs, see `cpu_tiles.assign_tiles`.
        geometry: Projected Gaussians, near to far. [V, 8]
        values: Their channels, depth and zeros. [V, B]
        labels: Plane of each Gaussian's votes, 0 for label -1. [V] int32, or empty
        planes: Number of planes, 0 for no labels.
        background: One row per pixel, or one for all. [H * W or 1, D]
        limits: Thresholds. [4] float32
        image, alpha, depth, transmittance, ids: Results. [H, W, D], [H, W] each
        tile_ends: One past the last pair that had a pixel left to draw on. [tiles]
    """
    height, width, n_channels = image.shape
    n_values = values.shape[1]
    columns = (width + TILE - 1) // TILE
    buffer = np.empty((n_values + planes) * PIXELS, np.float32)
    passed = np.empty(PIXELS, np.float32)
    flat_geometry, flat_values = geometry.reshape(-1), values.reshape(-1)
    log2_alpha_min, zero, one = splat(limits[LOG2_ALPHA_MIN]), splat(float32(0)), splat(float32(1))
    alpha_max, transmittance_min = splat(limits[ALPHA_MAX]), splat(limits[TRANSMITTANCE_MIN])
    for tile in range(worker, len(tile_starts) - 1, workers):
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        rows = min(TILE, height - y0)
        buffer[:] = 0
        passed[:] = 1
        end = tile_starts[tile]
        for pair in range(tile_starts[tile], tile_starts[tile + 1]):
            if (pair - tile_starts[tile]) % 16 == 15 and not _unfinished(passed, rows):
                break
            end = pair + 1
            rank = np.int64(pair_ranks[pair])
            g = rank * 8
            v = rank * n_values
            mean_x, mean_y = flat_geometry[g + MEAN_X], flat_geometry[g + MEAN_Y]
            l11, shift, l22 = flat_geometry[g + L11], flat_geometry[g + SHIFT], flat_geometry[g + L22]
            log2_opacity = flat_geometry[g + LOG2_OPACITY]
            first_row, last_row = _span(mean_y, flat_geometry[g + EXTENT_Y], float32(y0), rows)
            first, last = _span(mean_x, flat_geometry[g + EXTENT_X], float32(x0), TILE)
            vote = (n_values + np.int64(labels[rank])) * PIXELS if planes else np.int64(0)
            for half in range(first // LANES, last // LANES + 1):
                dx = iota() + splat(float32(x0 + half * LANES) + float32(0.5) - mean_x)
                for row in range(first_row, last_row + 1):
                    dy = float32(y0 + row) + float32(0.5) - mean_y
                    across = l22 * dy
                    u = splat(l11) * (dx - splat(shift * dy))
                    exponent = fma(-u, u, splat(log2_opacity - across * across))
                    at = (half * TILE + row) * LANES
                    before = load(passed, at)
                    valid = (exponent >= log2_alpha_min) & (before > zero)
                    if not any_of(valid):
                        continue
                    opaque = smaller(exp2(smaller(select(valid, exponent, zero), zero)), alpha_max)
                    after = before * (one - opaque)
                    goes_on = after >= transmittance_min
                    weight = select(valid & goes_on, before * opaque, zero)
                    store(passed, at, select(valid, select(goes_on, after, -before), before))
                    for c in range(0, n_values, 4):
                        k = c * PIXELS + at
                        store(buffer, k, fma(weight, splat(flat_values[v + c]), load(buffer, k)))
                        k += PIXELS
                        store(buffer, k, fma(weight, splat(flat_values[v + c + 1]), load(buffer, k)))
                        k += PIXELS
                        store(buffer, k, fma(weight, splat(flat_values[v + c + 2]), load(buffer, k)))
                        k += PIXELS
                        store(buffer, k, fma(weight, splat(flat_values[v + c + 3]), load(buffer, k)))
                    if planes:
                        store(buffer, vote + at, weight + load(buffer, vote + at))
        tile_ends[tile] = end

        for row in range(rows):
            for column in range(min(TILE, width - x0)):
                at = ((column // LANES) * TILE + row) * LANES + column % LANES
                y, x = y0 + row, x0 + column
                left = abs(passed[at])
                transmittance[y, x] = left
                alpha[y, x] = float32(1) - left
                depth[y, x] = buffer[n_channels * PIXELS + at] / (float32(1) - left) if left < 1 else float32(0)
                behind = (y * width + x) % len(background)
                for c in range(n_channels):
                    image[y, x, c] = buffer[c * PIXELS + at] + left * background[behind, c]
                if planes:
                    ids[y, x] = -1
                    if float32(1) - left >= limits[ID_ALPHA_MIN]:
                        best = float32(-1)
                        for plane in range(planes):
                            votes = buffer[(n_values + plane) * PIXELS + at]
                            if votes > best:
                                best = votes
                                ids[y, x] = plane - 1


@kernel
def _unfinished(passed, rows):
    """Whether any pixel of the first ``rows`` rows can still change."""
    for half in range(HALVES):
        for row in range(rows):
            if any_of(load(passed, (half * TILE + row) * LANES) > splat(float32(0))):
                return True
    return False


@kernel
def blend_backward(
    worker, workers, tile_starts, tile_ends, pair_ranks, pair_slots, geometry, values, background, limits, image, alpha,
    depth, transmittance, d_image, d_alpha, d_depth, slots,
):  # fmt: skip
    """Write the gradient slot of every pair of every workers-th tile: moments, then channels, depth and zeros.

    Goes near to far like `blend`. With s_i the inner product of channels and gradient, w_i the weight and h the gradient
    of what lies behind, dL/d(alpha_i) = T_i s_i - rest_i / (1 - alpha_i), where rest_i = sum_{j > i} w_j s_j + T_end h is
    the known total minus the terms passed so far: one number per pixel serves all channels.

    Args:
        as in `blend`; d_image [H, W, D], d_alpha [H, W] and d_depth [H, W] are the gradients of the results, the latter
            two empty where there is none; slots [S, 6 + B] the result.
    """
    height, width, n_channels = image.shape
    n_values, n_slots = values.shape[1], slots.shape[1]
    columns = (width + TILE - 1) // TILE
    gradient = np.empty(n_values * PIXELS, np.float32)
    passed, rest = np.empty(PIXELS, np.float32), np.empty(PIXELS, np.float32)
    d_values = np.empty(n_values * LANES, np.float32)
    flat_geometry, flat_values, flat_slots = geometry.reshape(-1), values.reshape(-1), slots.reshape(-1)
    log2_alpha_min, zero, one = splat(limits[LOG2_ALPHA_MIN]), splat(float32(0)), splat(float32(1))
    alpha_max, transmittance_min = splat(limits[ALPHA_MAX]), splat(limits[TRANSMITTANCE_MIN])
    for tile in range(worker, len(tile_starts) - 1, workers):
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        rows = min(TILE, height - y0)
        gradient[:] = 0
        rest[:] = 0
        passed[:] = 1
        for row in range(rows):
            for column in range(min(TILE, width - x0)):
                at = ((column // LANES) * TILE + row) * LANES + column % LANES
                y, x = y0 + row, x0 + column
                remaining = float32(0)
                for c in range(n_channels):
                    gradient[c * PIXELS + at] = d_image[y, x, c]
                    remaining += d_image[y, x, c] * image[y, x, c]
                to_alpha = d_alpha[y, x] if d_alpha.size else float32(0)
                if d_depth.size and alpha[y, x] > 0:
                    per_weight = d_depth[y, x] / alpha[y, x]
                    gradient[n_channels * PIXELS + at] = per_weight
                    remaining += d_depth[y, x] * depth[y, x]
                    to_alpha -= per_weight * depth[y, x]
                rest[at] = remaining - transmittance[y, x] * to_alpha

        for pair in range(tile_starts[tile], tile_starts[tile + 1]):
            slot = np.int64(pair_slots[pair]) * n_slots
            if pair >= tile_ends[tile]:
                for c in range(n_slots):
                    flat_slots[slot + c] = 0
                continue
            rank = np.int64(pair_ranks[pair])
            g = rank * 8
            v = rank * n_values
            mean_x, mean_y = flat_geometry[g + MEAN_X], flat_geometry[g + MEAN_Y]
            l11, shift, l22 = flat_geometry[g + L11], flat_geometry[g + SHIFT], flat_geometry[g + L22]
            log2_opacity = flat_geometry[g + LOG2_OPACITY]
            first_row, last_row = _span(mean_y, flat_geometry[g + EXTENT_Y], float32(y0), rows)
            first, last = _span(mean_x, flat_geometry[g + EXTENT_X], float32(x0), TILE)
            a, au, av, auu, auv, avv = zero, zero, zero, zero, zero, zero
            d_values[:] = 0
            for half in range(first // LANES, last // LANES + 1):
                dx = iota() + splat(float32(x0 + half * LANES) + float32(0.5) - mean_x)
                for row in range(first_row, last_row + 1):
                    dy = float32(y0 + row) + float32(0.5) - mean_y
                    across = l22 * dy
                    u = splat(l11) * (dx - splat(shift * dy))
                    exponent = fma(-u, u, splat(log2_opacity - across * across))
                    at = (half * TILE + row) * LANES
                    before = load(passed, at)
                    valid = (exponent >= log2_alpha_min) & (before > zero)
                    if not any_of(valid):
                        continue
                    uncapped = exp2(smaller(select(valid, exponent, zero), zero))
                    opaque = smaller(uncapped, alpha_max)
                    after = before * (one - opaque)
                    goes_on = after >= transmittance_min
                    used = valid & goes_on
                    weight = select(used, before * opaque, zero)
                    store(passed, at, select(valid, select(goes_on, after, -before), before))

                    inner = zero
                    for c in range(0, n_values, 4):
                        k = c * PIXELS + at
                        d = c * LANES
                        g0 = load(gradient, k)
                        g1 = load(gradient, k + PIXELS)
                        g2 = load(gradient, k + 2 * PIXELS)
                        g3 = load(gradient, k + 3 * PIXELS)
                        inner = fma(splat(flat_values[v + c]), g0, inner)
                        inner = fma(splat(flat_values[v + c + 1]), g1, inner)
                        inner = fma(splat(flat_values[v + c + 2]), g2, inner)
                        inner = fma(splat(flat_values[v + c + 3]), g3, inner)
                        store(d_values, d, fma(weight, g0, load(d_values, d)))
                        store(d_values, d + LANES, fma(weight, g1, load(d_values, d + LANES)))
                        store(d_values, d + 2 * LANES, fma(weight, g2, load(d_values, d + 2 * LANES)))
                        store(d_values, d + 3 * LANES, fma(weight, g3, load(d_values, d + 3 * LANES)))

                    own = weight * inner
                    remaining = load(rest, at) - own
                    store(rest, at, remaining)
                    # dL/d(ln alpha); zero where the cap holds, as the capped alpha does not move
                    to_log = own - remaining * opaque / (one - opaque)
                    to_log = select(used & (alpha_max >= uncapped), to_log, zero)
                    v_lanes = splat(across)
                    to_u = to_log * u
                    a = a + to_log
                    au = au + to_u
                    av = fma(to_log, v_lanes, av)
                    auu = fma(to_u, u, auu)
                    auv = fma(to_u, v_lanes, auv)
                    avv = fma(to_log, v_lanes * v_lanes, avv)
            flat_slots[slot] = total(a)
            flat_slots[slot + 1] = total(au)
            flat_slots[slot + 2] = total(av)
            flat_slots[slot + 3] = total(auu)
            flat_slots[slot + 4] = total(auv)
            flat_slots[slot + 5] = total(avv)
            for c in range(n_slots - MOMENTS):
                flat_slots[slot + MOMENTS + c] = total(load(d_values, c * LANES))
