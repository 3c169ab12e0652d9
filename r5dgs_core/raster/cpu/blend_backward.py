"""Kernel for the gradient of `blend`; see `batches` for tiles, blocks and batches."""

from __future__ import annotations

import numpy as np
from numba import float32

from ..compilation import helper, kernel
from .batches import (
    BATCH,
    FIRST,
    LANE_X,
    LANE_Y,
    MORE,
    PIXELS,
    T_L11,
    T_L12,
    T_L22,
    T_LOG2_OPACITY,
    VALUES,
    aligned,
    exponent_at,
    load_batch,
    opaque_at,
    padded,
    place_of,
    settle,
)
from .exact_thresholds import ALPHA_MAX, BLOCK, BLOCKS, CLOSE_LOG2, LOG2_ALPHA_MAX, LOG2_ALPHA_MIN
from .projection import TILE
from .simd.float32x16 import LANES, broadcast, load, load_rows, load_rows_of_three, reciprocal, splat, store, totals
from .simd.vectors import any_of, fma, lowest_bit, select, unlikely


@kernel
def blend_backward(
    worker, workers, tile_starts, tile_ends, pair_rows, pair_slots, pair_blocks, geometry, channels, depths, background,
    limits, alpha, depth, transmittance, last_pairs, d_image, d_alpha, d_depth, with_geometry, slots, filled,
):  # fmt: skip
    """Write the gradient slots of the pairs of every ``workers``-th tile: moments, gradients of values, zeros.

    Goes far to near. With s_i the inner product of values and gradient, and B_i the same for everything behind i at
    full transmittance, dL/d(alpha_i) = T_i (s_i - B_i) and B_{i-1} = B_i + alpha_i (s_i - B_i), starting with the inner
    product of background and gradient. One number per pixel thus serves all channels, and nothing cancels behind opaque
    Gaussians. T_i is recovered as T_{i+1} / (1 - alpha_i).

    Args:
        tile_starts, pair_rows, pair_slots: Pairs and their slots, see `tiles.assign_tiles`. [tiles + 1], [P], [P]
        tile_ends, pair_blocks, geometry, channels, depths, background, limits: Inputs and results of `blend.blend`,
            like alpha, depth, transmittance and last_pairs.
        d_image, d_alpha, d_depth: Gradients of the results; the latter two empty if absent. [H, W, D], [H, W], [H, W]
        with_geometry: True if more than the channels need gradients; otherwise the moments are zero.
        slots: Result, see `projection.MOMENTS`. [S, 16 k]
        filled: Result, initially False: mask of the written slots, those of pairs that contribute. [S]
    """
    height, width, n_channels = d_image.shape
    n_values, n_slots = padded(n_channels), slots.shape[1]
    columns = (width + TILE - 1) // TILE
    more = n_values > FIRST
    gradient = aligned(n_values * PIXELS)
    passed, behind, last = aligned(PIXELS), aligned(PIXELS), aligned(PIXELS)
    weights, inners = aligned(PIXELS), aligned(PIXELS)
    table, blocks = np.zeros((BATCH, VALUES + n_values), np.float32), np.empty(BATCH, np.uint64)
    flat, flat_slots = table.reshape(-1), slots.reshape(-1)
    no_votes = np.empty(0, np.int32)
    cut, cap, close = limits[LOG2_ALPHA_MIN], limits[LOG2_ALPHA_MAX], limits[CLOSE_LOG2]
    zero, one = splat(float32(0)), splat(float32(1))
    cut_low, cut_high = splat(float32(cut - close)), splat(float32(cut + close))
    cut_lanes, alpha_max = splat(float32(cut)), splat(float32(limits[ALPHA_MAX]))
    cap_low, cap_high = splat(float32(cap - close)), splat(float32(cap + close))
    lane_x, lane_y = load(LANE_X, 0), load(LANE_Y, 0)
    for tile in range(worker, len(tile_starts) - 1, workers):
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        tile_start, tile_end = tile_starts[tile], tile_ends[tile]
        if tile_end == tile_start:
            continue
        _start_backward(
            x0, y0, background, alpha, depth, transmittance, last_pairs, d_image, d_alpha, d_depth, gradient, passed,
            behind, last,
        )  # fmt: skip
        for batch in range((tile_end - tile_start - 1) // BATCH, -1, -1):
            begin = tile_start + batch * BATCH
            end = min(begin + BATCH, tile_end)
            load_batch(begin, end, end, x0, y0, pair_rows, geometry, channels, depths, no_votes, table, blocks)
            for k in range(end - begin - 1, -1, -1):
                drawn = pair_blocks[begin + k]
                if not drawn:
                    continue
                filled[pair_slots[begin + k]] = True
                slot = np.int64(pair_slots[begin + k]) * n_slots
                g = k * (VALUES + n_values)
                if more and with_geometry:
                    _inner_more(drawn, n_values, flat, g + VALUES, gradient, inners)
                u_lanes = broadcast(flat, g + T_L11) * lane_x - broadcast(flat, g + T_L12) * lane_y
                v_lanes = broadcast(flat, g + T_L22) * lane_y
                log2_opacity = broadcast(flat, g + T_LOG2_OPACITY)
                value_0, value_1 = broadcast(flat, g + VALUES), broadcast(flat, g + VALUES + 1)
                value_2, value_3 = broadcast(flat, g + VALUES + 2), broadcast(flat, g + VALUES + 3)
                number = splat(float32(begin + k - tile_start))
                a, au, av, auu, auv, avv = zero, zero, zero, zero, zero, zero
                d_0, d_1, d_2, d_3 = zero, zero, zero, zero
                touched = drawn
                while touched:
                    block = lowest_bit(touched)
                    touched &= touched - np.uint64(1)
                    column, row, at = block & 7, block >> 3, block * LANES
                    u, v, exponent = exponent_at(flat, g, column, row, u_lanes, v_lanes, log2_opacity)
                    valid = (exponent >= cut_low) & (load(last, at) > number)
                    if unlikely(any_of(valid & (cut_high > exponent))):
                        i = pair_rows[begin + k]
                        valid = settle(valid, valid & (cut_high > exponent), geometry, i, x0, y0, block, cut)
                    opaque = opaque_at(valid, exponent, cut_lanes, alpha_max)
                    before = load(passed, at) * select(valid, reciprocal(one - opaque), one)
                    store(passed, at, before)
                    weight = before * opaque
                    of = at * FIRST
                    g_0, g_1 = load(gradient, of), load(gradient, of + LANES)
                    g_2, g_3 = load(gradient, of + 2 * LANES), load(gradient, of + 3 * LANES)
                    d_0, d_1 = fma(weight, g_0, d_0), fma(weight, g_1, d_1)
                    d_2, d_3 = fma(weight, g_2, d_2), fma(weight, g_3, d_3)
                    if more:
                        store(weights, at, weight)
                    if not with_geometry:
                        continue
                    inner = fma(value_3, g_3, fma(value_2, g_2, fma(value_1, g_1, value_0 * g_0)))
                    if more:
                        inner = inner + load(inners, at)
                    seen_behind = load(behind, at)
                    gained = inner - seen_behind
                    store(behind, at, fma(opaque, gained, seen_behind))
                    # dL/d(ln alpha); zero for capped alphas, which are constant
                    to_log = weight * gained
                    capped = valid & (exponent >= cap_low)
                    if unlikely(any_of(capped)):
                        i = pair_rows[begin + k]
                        capped = settle(capped, capped & (cap_high > exponent), geometry, i, x0, y0, block, cap)
                        to_log = select(capped, zero, to_log)
                    to_u, to_v = to_log * u, to_log * v
                    a, au, av = a + to_log, au + to_u, av + to_v
                    auu, auv, avv = fma(to_u, u, auu), fma(to_u, v, auv), fma(to_v, v, avv)
                sums = totals((a, au, av, auu, auv, avv, d_0, d_1, d_2, d_3, zero, zero, zero, zero, zero, zero))
                store(flat_slots, slot, sums)
                if more:
                    _sum_more(drawn, n_values, weights, gradient, flat_slots, slot + LANES)


@helper
def _start_backward(
    x0, y0, background, alpha, depth, transmittance, last_pairs, d_image, d_alpha, d_depth, gradient, passed, behind,
    last,
):  # fmt: skip
    """Fill the tile buffers: gradient by each value, transmittance, and inner product with the background."""
    height, width, n_channels = d_image.shape
    gradient[:] = 0
    flat_gradient, flat_background = d_image.reshape(-1), background.reshape(-1)
    flat_end, flat_last = transmittance.reshape(-1), last_pairs.reshape(-1)
    flat_alpha, flat_depth = alpha.reshape(-1), depth.reshape(-1)
    to_alpha, to_depth = d_alpha.reshape(-1), d_depth.reshape(-1)
    zero, one = splat(float32(0)), splat(float32(1))
    one_background = len(background) == 1
    for block in range(BLOCKS * BLOCKS):
        left, top, at = x0 + block % BLOCKS * BLOCK, y0 + block // BLOCKS * BLOCK, block * LANES
        store(passed, at, one)
        store(behind, at, zero)
        store(last, at, -one)
        if left >= width or top >= height:
            continue
        pixel = top * width + left
        if n_channels == 3 and left + BLOCK <= width and top + BLOCK <= height:
            red, green, blue = load_rows_of_three(flat_gradient, 3 * pixel, 3 * width)
            of = at * FIRST
            store(gradient, of, red)
            store(gradient, of + LANES, green)
            store(gradient, of + 2 * LANES, blue)
            if one_background:
                seen = fma(broadcast(flat_background, 0), red, broadcast(flat_background, 1) * green)
                seen = fma(broadcast(flat_background, 2), blue, seen)
            else:
                shown = load_rows_of_three(flat_background, 3 * pixel, 3 * width)
                seen = fma(shown[0], red, fma(shown[1], green, shown[2] * blue))
            if len(to_alpha):
                seen = seen - load_rows(to_alpha, pixel, width)
            if len(to_depth):
                covers = load_rows(flat_alpha, pixel, width)
                per_weight = select(covers > zero, load_rows(to_depth, pixel, width), zero)
                per_weight = per_weight / select(covers > zero, covers, one)
                store(gradient, of + 3 * LANES, per_weight)
                seen = fma(per_weight, load_rows(flat_depth, pixel, width), seen)
            store(behind, at, seen)
            store(passed, at, load_rows(flat_end, pixel, width))
            store(last, at, load_rows(flat_last, pixel, width))
            continue
        for y in range(top, min(top + BLOCK, height)):
            for x in range(left, min(left + BLOCK, width)):
                pixel, lane = np.uint64(y * width + x), np.uint64((y - top) * BLOCK + x - left)
                of = pixel * np.uint64(n_channels)
                shown_at = np.uint64(0) if one_background else of
                seen = float32(0)
                for c in range(np.uint64(n_channels)):
                    gradient[np.uint64(place_of(c, block)) + lane] = flat_gradient[of + c]
                    seen += flat_gradient[of + c] * flat_background[shown_at + c]
                if len(to_alpha):
                    seen -= to_alpha[pixel]
                if len(to_depth) and flat_alpha[pixel] > 0:
                    per_weight = to_depth[pixel] / flat_alpha[pixel]
                    gradient[np.uint64(place_of(n_channels, block)) + lane] = per_weight
                    seen += per_weight * flat_depth[pixel]
                behind[np.uint64(at) + lane] = seen
                passed[np.uint64(at) + lane] = flat_end[pixel]
                last[np.uint64(at) + lane] = flat_last[pixel]


@helper
def _inner_more(drawn, n_values, flat, value, gradient, inners):
    """Inner product of one Gaussian's values beyond the first four with the gradient, for the blocks ``drawn``."""
    for chunk in range(FIRST, n_values, MORE):
        v = value + chunk
        v0, v1, v2, v3 = broadcast(flat, v), broadcast(flat, v + 1), broadcast(flat, v + 2), broadcast(flat, v + 3)
        v4, v5, v6, v7 = broadcast(flat, v + 4), broadcast(flat, v + 5), broadcast(flat, v + 6), broadcast(flat, v + 7)
        rest = drawn
        while rest:
            block = lowest_bit(rest)
            rest &= rest - np.uint64(1)
            of = chunk * PIXELS + block * LANES * MORE
            a = v0 * load(gradient, of)
            b = v1 * load(gradient, of + LANES)
            a = fma(v2, load(gradient, of + 2 * LANES), a)
            b = fma(v3, load(gradient, of + 3 * LANES), b)
            a = fma(v4, load(gradient, of + 4 * LANES), a)
            b = fma(v5, load(gradient, of + 5 * LANES), b)
            a = fma(v6, load(gradient, of + 6 * LANES), a)
            b = fma(v7, load(gradient, of + 7 * LANES), b)
            inner = a + b
            if chunk > FIRST:
                inner = inner + load(inners, block * LANES)
            store(inners, block * LANES, inner)


@helper
def _sum_more(drawn, n_values, weights, gradient, flat_slots, slot):
    """Sum the gradients of one Gaussian's values beyond the first four over the blocks ``drawn``."""
    zero = splat(float32(0))
    for chunk in range(FIRST, n_values, 2 * MORE):
        low = _sum_chunk(drawn, chunk, weights, gradient)
        high = (zero, zero, zero, zero, zero, zero, zero, zero)
        if chunk + MORE < n_values:
            high = _sum_chunk(drawn, chunk + MORE, weights, gradient)
        store(flat_slots, slot, totals(low + high))
        slot += LANES


@helper
def _sum_chunk(drawn, chunk, weights, gradient):
    zero = splat(float32(0))
    d0, d1, d2, d3, d4, d5, d6, d7 = zero, zero, zero, zero, zero, zero, zero, zero
    while drawn:
        block = lowest_bit(drawn)
        drawn &= drawn - np.uint64(1)
        weight, of = load(weights, block * LANES), chunk * PIXELS + block * LANES * MORE
        d0 = fma(weight, load(gradient, of), d0)
        d1 = fma(weight, load(gradient, of + LANES), d1)
        d2 = fma(weight, load(gradient, of + 2 * LANES), d2)
        d3 = fma(weight, load(gradient, of + 3 * LANES), d3)
        d4 = fma(weight, load(gradient, of + 4 * LANES), d4)
        d5 = fma(weight, load(gradient, of + 5 * LANES), d5)
        d6 = fma(weight, load(gradient, of + 6 * LANES), d6)
        d7 = fma(weight, load(gradient, of + 7 * LANES), d7)
    return d0, d1, d2, d3, d4, d5, d6, d7
