"""Blending kernel; see `batches` for tiles, blocks and batches.

The first four values of a pair are added as soon as its weight is known, further values in a second sweep over the
Gaussian's blocks. The transmittance T of pixels that are finished or outside the image is stored with a negative sign.
"""

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
from .exact_thresholds import (
    ALPHA_MAX,
    BLOCK,
    BLOCKS,
    CLOSE_LOG2,
    CLOSE_TRANSMITTANCE,
    ID_ALPHA_MIN,
    LOG2_ALPHA_MIN,
    TRANSMITTANCE_MIN,
    lanes_that_finish,
)
from .projection import TILE
from .simd.float32x16 import (
    LANES,
    broadcast,
    load,
    load_rows_of_three,
    mask_of,
    splat,
    store,
    store_rows,
    store_rows_of_three,
)
from .simd.vectors import any_of, bits_of, fma, larger, lowest_bit, select, unlikely


@helper
def _start_tile(passed, x0, y0, width, height):
    """Initialise the transmittance of a tile's pixels; return the blocks with pixels inside the image."""
    alive = np.uint64(0)
    columns, rows = min(width - x0, TILE), min(height - y0, TILE)
    for block in range(BLOCKS * BLOCKS):
        left, top = block % BLOCKS * BLOCK, block // BLOCKS * BLOCK
        for lane in range(LANES):
            inside = left + lane % BLOCK < columns and top + lane // BLOCK < rows
            passed[block * LANES + lane] = float32(1) if inside else float32(-1)
        if left < columns and top < rows:
            alive |= np.uint64(1) << np.uint64(block)
    return alive


@kernel
def blend(
    worker, workers, tiles, tile_starts, pair_rows, geometry, channels, depths, votes, names, background, limits, image,
    alpha, depth, transmittance, last_pairs, ids, tile_ends, pair_blocks,
):  # fmt: skip
    """Blend the worker's share of some tiles, every ``workers``-th; other pixels are not written.

    Args:
        tiles: Tiles to blend, numbered row by row. [K]
        tile_starts, pair_rows: Their pairs, see `tiles`. [K + 1], [P]
        geometry: Projected Gaussians. [N, 8] float64
        channels, depths: Values to blend. [N, D], [N]
        votes: Index of each Gaussian's label in ``names``. [N] int32, or empty
        names: The labels, ascending, -1 or more. [L] float32, or empty
        background: One row per pixel, or one for all. [H * W or 1, D]
        limits: Thresholds, see `exact_thresholds`. [6] float64
        image, alpha, depth: Results. [H, W, D], [H, W], [H, W]
        transmittance: Result, final transmittance, for the backward pass. [H, W], or empty
        last_pairs: Result, number of the tile's pairs before the pixel was finished, for the backward pass.
            [H, W] float32, or empty
        ids: Result, label of each pixel. [H, W], or empty
        tile_ends: Result, one past the last pair processed before all pixels were finished. [K]
        pair_blocks: Result, the blocks that each pair contributes to. [P] uint64
    """
    height, width, n_channels = image.shape
    n_values = padded(n_channels)
    columns = (width + TILE - 1) // TILE
    more, planes = n_values > FIRST, len(names)
    buffer, ballot = aligned(n_values * PIXELS), aligned(planes * PIXELS)
    passed, weights, last = aligned(PIXELS), aligned(PIXELS), aligned(PIXELS)
    covered = aligned(PIXELS)  # sum of weights: unlike 1 - T, exact at low coverage
    table, blocks = np.zeros((BATCH, VALUES + n_values), np.float32), np.empty(BATCH, np.uint64)
    flat = table.reshape(-1)
    cut, close, zero = limits[LOG2_ALPHA_MIN], limits[CLOSE_LOG2], splat(float32(0))
    cut_low, cut_high = splat(float32(cut - close)), splat(float32(cut + close))
    cut_lanes, alpha_max = splat(float32(cut)), splat(float32(limits[ALPHA_MAX]))
    end_low = splat(float32(limits[TRANSMITTANCE_MIN] * (1 - CLOSE_TRANSMITTANCE)))
    end_high = splat(float32(limits[TRANSMITTANCE_MIN] * (1 + CLOSE_TRANSMITTANCE)))
    lane_x, lane_y = load(LANE_X, 0), load(LANE_Y, 0)
    for place in range(worker, len(tiles), workers):
        x0, y0 = tiles[place] % columns * TILE, tiles[place] // columns * TILE
        tile_start, tile_stop = tile_starts[place], tile_starts[place + 1]
        buffer[:] = 0
        ballot[:] = 0
        covered[:] = 0
        last[:] = tile_stop - tile_start
        alive = _start_tile(passed, x0, y0, width, height)
        begin, end = tile_start, tile_start
        while begin < tile_stop and alive:
            end = min(begin + BATCH, tile_stop)
            load_batch(begin, end, tile_stop, x0, y0, pair_rows, geometry, channels, depths, votes, table, blocks)
            for k in range(end - begin):
                touched = blocks[k] & alive
                drawn = np.uint64(0)
                if touched:
                    g = k * (VALUES + n_values)
                    u_lanes = broadcast(flat, g + T_L11) * lane_x - broadcast(flat, g + T_L12) * lane_y
                    v_lanes = broadcast(flat, g + T_L22) * lane_y
                    log2_opacity = broadcast(flat, g + T_LOG2_OPACITY)
                    value_0, value_1 = broadcast(flat, g + VALUES), broadcast(flat, g + VALUES + 1)
                    value_2, value_3 = broadcast(flat, g + VALUES + 2), broadcast(flat, g + VALUES + 3)
                    vote = np.int64(votes[pair_rows[begin + k]]) * PIXELS if planes else np.int64(0)
                    while touched:
                        block = lowest_bit(touched)
                        bit = touched & (~touched + np.uint64(1))
                        touched ^= bit
                        column, row, at = block & 7, block >> 3, block * LANES
                        _, _, exponent = exponent_at(flat, g, column, row, u_lanes, v_lanes, log2_opacity)
                        before = load(passed, at)
                        valid = (exponent >= cut_low) & (before > zero)
                        if not any_of(valid):
                            continue
                        if unlikely(any_of(valid & (cut_high > exponent))):
                            i = pair_rows[begin + k]
                            valid = settle(valid, valid & (cut_high > exponent), geometry, i, x0, y0, block, cut)
                        opaque = opaque_at(valid, exponent, cut_lanes, alpha_max)
                        weight = before * opaque
                        after = before - weight
                        ends = valid & (end_high > after)
                        if unlikely(any_of(ends)):
                            unsure = bits_of(ends & (after >= end_low))
                            if unsure:
                                pair_blocks[begin + k] = drawn | bit
                                ending = bits_of(ends) ^ unsure
                                ends = mask_of(ending | lanes_that_finish(
                                    unsure, geometry, pair_rows, pair_blocks, tile_start, begin + k + 1, x0, y0, block,
                                    limits,
                                ))  # fmt: skip
                            weight = select(ends, zero, weight)
                            after = select(ends, -before, after)
                            store(last, at, select(ends, splat(float32(begin + k - tile_start)), load(last, at)))
                            if not any_of(after > zero):
                                alive ^= bit
                        drawn |= bit
                        store(passed, at, after)
                        store(covered, at, weight + load(covered, at))
                        to = at * FIRST
                        store(buffer, to, fma(weight, value_0, load(buffer, to)))
                        store(buffer, to + LANES, fma(weight, value_1, load(buffer, to + LANES)))
                        store(buffer, to + 2 * LANES, fma(weight, value_2, load(buffer, to + 2 * LANES)))
                        store(buffer, to + 3 * LANES, fma(weight, value_3, load(buffer, to + 3 * LANES)))
                        if more:
                            store(weights, at, weight)
                        if planes:
                            store(ballot, vote + at, weight + load(ballot, vote + at))
                    if more and drawn:
                        _blend_more(drawn, n_values, weights, flat, g + VALUES, buffer)
                pair_blocks[begin + k] = drawn
            begin = end
        tile_ends[place] = end
        _finish_tile(
            x0, y0, names, buffer, ballot, passed, covered, last, background, limits, image, alpha, depth,
            transmittance, last_pairs, ids,
        )  # fmt: skip


@helper
def _blend_more(drawn, n_values, weights, flat, value, buffer):
    """Add one Gaussian's values beyond the first four to the blocks ``drawn``."""
    for chunk in range(FIRST, n_values, MORE):
        v = value + chunk
        v0, v1, v2, v3 = broadcast(flat, v), broadcast(flat, v + 1), broadcast(flat, v + 2), broadcast(flat, v + 3)
        v4, v5, v6, v7 = broadcast(flat, v + 4), broadcast(flat, v + 5), broadcast(flat, v + 6), broadcast(flat, v + 7)
        rest = drawn
        while rest:
            block = lowest_bit(rest)
            rest &= rest - np.uint64(1)
            weight = load(weights, block * LANES)
            to = chunk * PIXELS + block * LANES * MORE
            store(buffer, to, fma(weight, v0, load(buffer, to)))
            store(buffer, to + LANES, fma(weight, v1, load(buffer, to + LANES)))
            store(buffer, to + 2 * LANES, fma(weight, v2, load(buffer, to + 2 * LANES)))
            store(buffer, to + 3 * LANES, fma(weight, v3, load(buffer, to + 3 * LANES)))
            store(buffer, to + 4 * LANES, fma(weight, v4, load(buffer, to + 4 * LANES)))
            store(buffer, to + 5 * LANES, fma(weight, v5, load(buffer, to + 5 * LANES)))
            store(buffer, to + 6 * LANES, fma(weight, v6, load(buffer, to + 6 * LANES)))
            store(buffer, to + 7 * LANES, fma(weight, v7, load(buffer, to + 7 * LANES)))


@helper
def _finish_tile(
    x0, y0, names, buffer, ballot, passed, covered, last, background, limits, image, alpha, depth, transmittance,
    last_pairs, ids,
):  # fmt: skip
    """Write the pixels of a tile to the results."""
    height, width, n_channels = image.shape
    planes = len(names)
    zero, one, nobody = splat(float32(0)), splat(float32(1)), splat(float32(-1))
    id_alpha_min = splat(float32(limits[ID_ALPHA_MIN]))
    one_background = len(background) == 1
    three = n_channels == 3
    pixels = aligned((n_channels + 4) * LANES)
    at_alpha, at_depth, at_id = n_channels * LANES, (n_channels + 1) * LANES, (n_channels + 2) * LANES
    flat_image, flat_alpha, flat_depth = image.reshape(-1), alpha.reshape(-1), depth.reshape(-1)
    flat_end, flat_background = transmittance.reshape(-1), background.reshape(-1)
    flat_ids, flat_last = ids.reshape(-1), last_pairs.reshape(-1)
    for block in range(BLOCKS * BLOCKS):
        left, top, at = x0 + block % BLOCKS * BLOCK, y0 + block // BLOCKS * BLOCK, block * LANES
        if left >= width or top >= height:
            continue
        passes = load(passed, at)
        passes = larger(passes, -passes)
        store(passed, at, passes)
        covers = load(covered, at)
        store(pixels, at_alpha, covers)
        distance = load(buffer, place_of(n_channels, block)) / select(covers > zero, covers, one)
        store(pixels, at_depth, select(covers > zero, distance, zero))
        for c in range(n_channels):
            blended = load(buffer, place_of(c, block))
            if one_background:
                blended = fma(passes, broadcast(flat_background, c), blended)
            store(pixels, c * LANES, blended)
        if planes:
            most, winner = zero, nobody
            for plane in range(planes):
                weight = load(ballot, plane * PIXELS + at)
                wins = weight > most
                most, winner = select(wins, weight, most), select(wins, broadcast(names, plane), winner)
            store(pixels, at_id, select(covers >= id_alpha_min, winner, nobody))
        if left + BLOCK <= width and top + BLOCK <= height and three:
            pixel = top * width + left
            store_rows(flat_alpha, pixel, width, covers)
            store_rows(flat_depth, pixel, width, load(pixels, at_depth))
            if len(transmittance):
                store_rows(flat_end, pixel, width, passes)
                store_rows(flat_last, pixel, width, load(last, at))
            if planes:
                store_rows(flat_ids, pixel, width, load(pixels, at_id))
            red, green, blue = load(pixels, 0), load(pixels, LANES), load(pixels, 2 * LANES)
            if not one_background:
                behind = load_rows_of_three(flat_background, 3 * pixel, 3 * width)
                red, green = fma(passes, behind[0], red), fma(passes, behind[1], green)
                blue = fma(passes, behind[2], blue)
            store_rows_of_three(flat_image, 3 * pixel, 3 * width, red, green, blue)
            continue
        for y in range(top, min(top + BLOCK, height)):
            for x in range(left, min(left + BLOCK, width)):
                pixel, lane = np.uint64(y * width + x), np.uint64((y - top) * BLOCK + x - left)
                flat_alpha[pixel] = pixels[np.uint64(at_alpha) + lane]
                flat_depth[pixel] = pixels[np.uint64(at_depth) + lane]
                if len(transmittance):
                    flat_end[pixel] = passed[np.uint64(at) + lane]
                    flat_last[pixel] = last[np.uint64(at) + lane]
                if planes:
                    flat_ids[pixel] = np.int32(pixels[np.uint64(at_id) + lane])
                to = pixel * np.uint64(n_channels)
                for c in range(np.uint64(n_channels)):
                    flat_image[to + c] = pixels[c * np.uint64(LANES) + lane]
                if not one_background:
                    for c in range(np.uint64(n_channels)):
                        flat_image[to + c] += passed[np.uint64(at) + lane] * flat_background[to + c]
