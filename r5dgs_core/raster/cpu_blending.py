"""Kernels that blend the pairs of each tile, and take the gradient of that.

A tile is worked on in strips of eight pixels of one row (`lanes`), numbered column of strips by column of strips. Tile
buffers keep what belongs to a strip together. Channels come in fours: the D channels, then depth, then zeros. A
finished pixel keeps its transmittance T with the sign turned. Pairs are copied to a small tile-local table a batch at a
time: the copies do not wait for each other, so that their cache misses overlap, and what follows has it all close by.
"""

from __future__ import annotations

import numpy as np
from numba import float32

from .compile import kernel
from .cpu_projection import EXTENT_X, EXTENT_Y, GEOMETRY, L11, L22, LOG2_OPACITY, MEAN_X, MEAN_Y, MOMENTS, SHIFT
from .cpu_tiles import TILE
from .lanes import LANES, any_of, broadcast, exp2, fma, iota, larger, load, select, smaller, splat, store, total

PIXELS = TILE * TILE
BATCH = 64  # pairs

# Entries of the limits vector (float32).
LOG2_ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN, ID_ALPHA_MIN = range(4)


@kernel
def _load_batch(begin, end, x0, y0, rows, pair_ranks, geometry, values, table, strips):
    """Copy pairs begin : end of a tile to rows of ``table``: centre relative to the tile, rest of the geometry, values.

    ``strips`` takes their first and last column of strips and their first and last row of pixels. [BATCH, 4]
    """
    n_values = values.shape[1]
    for k in range(end - begin):
        rank = np.uint64(pair_ranks[begin + k])
        x = geometry[rank, MEAN_X] - float32(x0)
        y = geometry[rank, MEAN_Y] - float32(y0)
        extent_x, extent_y = geometry[rank, EXTENT_X], geometry[rank, EXTENT_Y]
        # pixel centres lie at +0.5; 0.01 px more than that, because rounding must not lose a pixel
        strips[k, 0] = int(np.ceil(max(x - extent_x - float32(0.51), float32(0)))) // LANES
        strips[k, 1] = int(np.floor(min(x + extent_x - float32(0.49), float32(TILE - 1)))) // LANES
        strips[k, 2] = int(np.ceil(max(y - extent_y - float32(0.51), float32(0))))
        strips[k, 3] = int(np.floor(min(y + extent_y - float32(0.49), float32(rows - 1))))
        table[k, MEAN_X], table[k, MEAN_Y] = x, y
        table[k, L11], table[k, SHIFT], table[k, L22] = geometry[rank, L11], geometry[rank, SHIFT], geometry[rank, L22]
        table[k, LOG2_OPACITY] = geometry[rank, LOG2_OPACITY]
        for c in range(n_values):
            table[k, GEOMETRY + c] = values[rank, c]


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
    n_planes = n_values + planes
    columns = (width + TILE - 1) // TILE
    buffer = np.empty(n_planes * PIXELS, np.float32)
    passed = np.empty(PIXELS, np.float32)
    table, strips = np.empty((BATCH, GEOMETRY + n_values), np.float32), np.empty((BATCH, 4), np.int64)
    flat = table.reshape(-1)
    log2_alpha_min, zero = splat(limits[LOG2_ALPHA_MIN]), splat(float32(0))
    alpha_max, transmittance_min = splat(limits[ALPHA_MAX]), splat(limits[TRANSMITTANCE_MIN])
    for tile in range(worker, len(tile_starts) - 1, workers):
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        rows = min(TILE, height - y0)
        buffer[:] = 0
        passed[:] = 1
        begin, end = tile_starts[tile], tile_starts[tile]
        while begin < tile_starts[tile + 1] and _unfinished(passed, rows):
            end = min(begin + BATCH, tile_starts[tile + 1])
            _load_batch(begin, end, x0, y0, rows, pair_ranks, geometry, values, table, strips)
            for k in range(end - begin):
                g = k * (GEOMETRY + n_values)
                l11, log2_opacity = broadcast(flat, g + L11), flat[g + LOG2_OPACITY]
                mean_x, mean_y, shift, l22 = flat[g + MEAN_X], flat[g + MEAN_Y], flat[g + SHIFT], flat[g + L22]
                vote = n_values + np.int64(labels[pair_ranks[begin + k]]) if planes else np.int64(0)
                for column in range(strips[k, 0], strips[k, 1] + 1):
                    dx = iota() + splat(float32(column * LANES) + float32(0.5) - mean_x)
                    for row in range(strips[k, 2], strips[k, 3] + 1):
                        dy = float32(row) + float32(0.5) - mean_y
                        across = l22 * dy
                        u = l11 * (dx - splat(shift * dy))
                        exponent = fma(-u, u, splat(log2_opacity - across * across))
                        at = (column * TILE + row) * LANES
                        before = load(passed, at)
                        valid = (exponent >= log2_alpha_min) & (before > zero)
                        if not any_of(valid):
                            continue
                        opaque = smaller(exp2(larger(exponent, log2_alpha_min)), alpha_max)
                        weight = before * opaque
                        after = before - weight
                        goes_on = after >= transmittance_min
                        weight = select(valid & goes_on, weight, zero)
                        store(passed, at, select(valid, select(goes_on, after, -before), before))
                        value, to = g + GEOMETRY, at * n_planes
                        for _ in range(0, n_values, 4):
                            store(buffer, to, fma(weight, broadcast(flat, value), load(buffer, to)))
                            to += LANES
                            store(buffer, to, fma(weight, broadcast(flat, value + 1), load(buffer, to)))
                            to += LANES
                            store(buffer, to, fma(weight, broadcast(flat, value + 2), load(buffer, to)))
                            to += LANES
                            store(buffer, to, fma(weight, broadcast(flat, value + 3), load(buffer, to)))
                            to += LANES
                            value += 4
                        if planes:
                            to = at * n_planes + vote * LANES
                            store(buffer, to, weight + load(buffer, to))
            begin = end
        tile_ends[tile] = end

        for row in range(rows):
            for column in range(min(TILE, width - x0)):
                strip = column // LANES * TILE + row
                at = strip * LANES * n_planes + column % LANES
                y, x = y0 + row, x0 + column
                left = abs(passed[strip * LANES + column % LANES])
                covered = float32(1) - left
                transmittance[y, x] = left
                alpha[y, x] = covered
                depth[y, x] = buffer[at + n_channels * LANES] / covered if covered > 0 else float32(0)
                behind = y * width + x if len(background) > 1 else 0
                for c in range(n_channels):
                    image[y, x, c] = buffer[at + c * LANES] + left * background[behind, c]
                if planes:
                    ids[y, x] = -1
                    if covered >= limits[ID_ALPHA_MIN]:
                        best = float32(-1)
                        for plane in range(planes):
                            votes = buffer[at + (n_values + plane) * LANES]
                            if votes > best:
                                best = votes
                                ids[y, x] = plane - 1


@kernel
def _unfinished(passed, rows):
    """Whether any pixel of the first ``rows`` rows can still change."""
    for column in range(TILE // LANES):
        for row in range(rows):
            if any_of(load(passed, (column * TILE + row) * LANES) > splat(float32(0))):
                return True
    return False


@kernel
def blend_backward(
    worker, workers, tile_starts, tile_ends, pair_ranks, pair_slots, geometry, values, limits, image, alpha, depth,
    transmittance, d_image, d_alpha, d_depth, with_geometry, slots,
):  # fmt: skip
    """Write the gradient slot of every pair of every workers-th tile: moments, then channels, depth and zeros.

    Goes near to far like `blend`. With s_i the inner product of channels and gradient, w_i the weight and h the
    gradient of what lies behind, dL/d(alpha_i) = T_i s_i - rest_i / (1 - alpha_i), where the rest, the sum of w_j s_j
    over j > i plus T_end h, is the known total minus the terms passed so far: one number per pixel serves all channels.

    Args:
        as in `blend`; d_image [H, W, D], d_alpha [H, W] and d_depth [H, W] are the gradients of the results, the
            latter two empty where there is none; with_geometry is whether more than channels want a gradient, or else
            the moments are zero; slots [S, 6 + B] the result.
    """
    height, width, n_channels = image.shape
    n_values, n_slots = values.shape[1], slots.shape[1]
    columns = (width + TILE - 1) // TILE
    gradient = np.empty(n_values * PIXELS, np.float32)
    passed, rest = np.empty(PIXELS, np.float32), np.empty(PIXELS, np.float32)
    d_values = np.empty(n_values * LANES, np.float32)
    table, strips = np.empty((BATCH, GEOMETRY + n_values), np.float32), np.empty((BATCH, 4), np.int64)
    flat, flat_slots = table.reshape(-1), slots.reshape(-1)
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
                strip = column // LANES * TILE + row
                at = strip * LANES * n_values + column % LANES
                y, x = y0 + row, x0 + column
                remaining = float32(0)
                for c in range(n_channels):
                    gradient[at + c * LANES] = d_image[y, x, c]
                    remaining += d_image[y, x, c] * image[y, x, c]
                to_alpha = d_alpha[y, x] if d_alpha.size else float32(0)
                if d_depth.size and alpha[y, x] > 0:
                    per_weight = d_depth[y, x] / alpha[y, x]
                    gradient[at + n_channels * LANES] = per_weight
                    remaining += d_depth[y, x] * depth[y, x]
                    to_alpha -= per_weight * depth[y, x]
                rest[strip * LANES + column % LANES] = remaining - transmittance[y, x] * to_alpha

        for begin in range(tile_starts[tile], tile_ends[tile], BATCH):
            end = min(begin + BATCH, tile_ends[tile])
            _load_batch(begin, end, x0, y0, rows, pair_ranks, geometry, values, table, strips)
            for k in range(end - begin):
                g = k * (GEOMETRY + n_values)
                l11, log2_opacity = broadcast(flat, g + L11), flat[g + LOG2_OPACITY]
                mean_x, mean_y, shift, l22 = flat[g + MEAN_X], flat[g + MEAN_Y], flat[g + SHIFT], flat[g + L22]
                a, au, av, auu, auv, avv = zero, zero, zero, zero, zero, zero
                for c in range(n_values):
                    store(d_values, c * LANES, zero)
                for column in range(strips[k, 0], strips[k, 1] + 1):
                    dx = iota() + splat(float32(column * LANES) + float32(0.5) - mean_x)
                    for row in range(strips[k, 2], strips[k, 3] + 1):
                        dy = float32(row) + float32(0.5) - mean_y
                        across = l22 * dy
                        u = l11 * (dx - splat(shift * dy))
                        exponent = fma(-u, u, splat(log2_opacity - across * across))
                        at = (column * TILE + row) * LANES
                        before = load(passed, at)
                        valid = (exponent >= log2_alpha_min) & (before > zero)
                        if not any_of(valid):
                            continue
                        uncapped = exp2(larger(exponent, log2_alpha_min))
                        opaque = smaller(uncapped, alpha_max)
                        weight = before * opaque
                        after = before - weight
                        goes_on = after >= transmittance_min
                        used = valid & goes_on
                        weight = select(used, weight, zero)
                        store(passed, at, select(valid, select(goes_on, after, -before), before))

                        inner = zero
                        value, of, to = g + GEOMETRY, at * n_values, np.int64(0)
                        for _ in range(0, n_values, 4):
                            g0, g1 = load(gradient, of), load(gradient, of + LANES)
                            g2, g3 = load(gradient, of + 2 * LANES), load(gradient, of + 3 * LANES)
                            if with_geometry:
                                inner = fma(broadcast(flat, value), g0, inner)
                                inner = fma(broadcast(flat, value + 1), g1, inner)
                                inner = fma(broadcast(flat, value + 2), g2, inner)
                                inner = fma(broadcast(flat, value + 3), g3, inner)
                            store(d_values, to, fma(weight, g0, load(d_values, to)))
                            to += LANES
                            store(d_values, to, fma(weight, g1, load(d_values, to)))
                            to += LANES
                            store(d_values, to, fma(weight, g2, load(d_values, to)))
                            to += LANES
                            store(d_values, to, fma(weight, g3, load(d_values, to)))
                            to += LANES
                            of += 4 * LANES
                            value += 4

                        if not with_geometry:
                            continue
                        own = weight * inner
                        remaining = load(rest, at) - own
                        store(rest, at, remaining)
                        # dL/d(ln alpha); zero where the cap holds, as the capped alpha does not move
                        to_log = own - remaining * opaque / (one - opaque)
                        to_log = select(used & (alpha_max >= uncapped), to_log, zero)
                        to_u, v = to_log * u, splat(across)
                        a = a + to_log
                        au = au + to_u
                        av = fma(to_log, v, av)
                        auu = fma(to_u, u, auu)
                        auv = fma(to_u, v, auv)
                        avv = fma(to_log, v * v, avv)
                slot = np.int64(pair_slots[begin + k]) * n_slots
                flat_slots[slot] = total(a)
                flat_slots[slot + 1] = total(au)
                flat_slots[slot + 2] = total(av)
                flat_slots[slot + 3] = total(auu)
                flat_slots[slot + 4] = total(auv)
                flat_slots[slot + 5] = total(avv)
                for c in range(n_slots - MOMENTS):
                    flat_slots[slot + MOMENTS + c] = total(load(d_values, c * LANES))
        for pair in range(tile_ends[tile], tile_starts[tile + 1]):
            slots[pair_slots[pair]] = 0
