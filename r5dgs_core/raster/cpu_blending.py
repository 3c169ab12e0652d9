"""Kernels that blend the pairs of each tile, and take the gradient of that.

A tile is worked on in blocks of 4 x 4 pixels, one vector each (`lanes`), numbered row by row: the blocks that a
Gaussian may touch are the set bits of one integer. Tile buffers keep what belongs to a block together. The first four
values (channels, then depth, then zeros) are worked on as soon as a weight is known; further values come in eights, in
a second sweep over the blocks of the same Gaussian. A finished pixel keeps its transmittance T with the sign turned,
and so does one outside the image. Pairs are copied to a small tile-local table a batch at a time: the copies do not
wait for each other, so that their cache misses overlap, and what follows has it all close by.

With (x, y) the place of a lane in its block, the whitened offset from the centre of the Gaussian is
u = (l11 x - l12 y) + a term per column of blocks + a term per row, and v = l22 y + a term per row; all of them count
from the middle of the tile, where they are taken in float64, and are small wherever the Gaussian is seen.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32

from .compile import helper, kernel
from .cpu_exact import (
    ALPHA_MAX,
    BLOCK,
    BLOCKS,
    CLOSE_LOG2,
    CLOSE_TRANSMITTANCE,
    ID_ALPHA_MIN,
    LOG2_ALPHA_MAX,
    LOG2_ALPHA_MIN,
    TRANSMITTANCE_MIN,
    lanes_at_least,
    lanes_that_finish,
)
from .cpu_projection import EXTENT_X, EXTENT_Y, GEOMETRY, L11, L12, L22, LOG2_OPACITY, MEAN_X, MEAN_Y, TILE
from .lanes import (
    LANES,
    broadcast,
    exp2,
    load,
    load_rows,
    load_rows_of_three,
    mask_of,
    reciprocal,
    splat,
    store,
    store_rows,
    store_rows_of_three,
    store_whole_rows,
    totals,
)
from .vectors import any_of, bits_of, fma, larger, lowest_bit, prefetch, select, smaller, unlikely

PIXELS = TILE * TILE
BATCH = 64  # pairs
AHEAD = 12  # pairs
FIRST = 4  # values that are worked on at once
MORE = 8  # further values come in multiples of this

# Columns of the tile-local table: terms of u per column and row of blocks, of v per row, then the numbers of the
# Gaussian and its values.
U_COLUMN, U_ROW, V_ROW = 0, BLOCKS, 2 * BLOCKS
T_L11, T_L12, T_L22, T_LOG2_OPACITY = (3 * BLOCKS + i for i in range(4))
VALUES = 3 * BLOCKS + 4

_OFFSETS = np.array([BLOCK * (b % BLOCKS - 0.5 * BLOCKS) + 0.5 for b in range(LANES)], np.float32)
_OF_ROWS = np.array([b // BLOCKS for b in range(LANES)], np.float32)  # 0 for columns, 1 for rows
_X = np.array([lane % BLOCK for lane in range(LANES)], np.float32)
_Y = np.array([lane // BLOCK for lane in range(LANES)], np.float32)


def padded_values(n_channels: int) -> int:
    """Number of values that are blended for a number of channels: those, depth, and zeros."""
    return FIRST + max(0, -(-(n_channels + 1 - FIRST) // MORE)) * MORE


@helper
def aligned(count):
    """An array of float32 that begins where a vector of the machine would: loads and stores then never straddle."""
    array = np.empty(count + LANES, np.float32)
    skip = (-array.ctypes.data // 4) % LANES
    return array[skip : skip + count]


@helper
def _load_batch(begin, end, stop, x0, y0, pair_rows, geometry, channels, depths, votes, table, blocks):
    """Copy pairs begin : end of a tile to rows of ``table``; ``blocks`` takes the blocks that their box touches.

    What the pairs up to ``stop`` need is asked for a few pairs ahead, as it lies anywhere in memory.
    """
    n_channels, width = channels.shape[1], table.shape[1]
    flat, flat_geometry, flat_channels = table.reshape(-1), geometry.reshape(-1), channels.reshape(-1)
    middle_x, middle_y = x0 + 0.5 * TILE, y0 + 0.5 * TILE
    offsets, of_rows = load(_OFFSETS, 0), load(_OF_ROWS, 0) > splat(float32(0))
    for k in range(end - begin):
        ahead = begin + k + AHEAD
        if ahead < stop:
            coming = np.int64(pair_rows[ahead])
            prefetch(flat_geometry, coming * GEOMETRY)
            prefetch(flat_channels, coming * n_channels)
            prefetch(depths, coming)
            if len(votes):
                prefetch(votes, coming)
        i = np.uint64(pair_rows[begin + k])
        l11, l12, l22 = geometry[i, L11], geometry[i, L12], geometry[i, L22]
        dx, dy = middle_x - geometry[i, MEAN_X], middle_y - geometry[i, MEAN_Y]
        extent_x, extent_y = geometry[i, EXTENT_X], geometry[i, EXTENT_Y]
        # pixel centres lie at +0.5; 0.01 px more than that, because rounding must not lose a pixel
        left = max(0.5 * TILE - 0.51 - dx - extent_x, 0.0)
        right = min(0.5 * TILE - 0.49 - dx + extent_x, TILE - 1.0)
        top = max(0.5 * TILE - 0.51 - dy - extent_y, 0.0)
        bottom = min(0.5 * TILE - 0.49 - dy + extent_y, TILE - 1.0)
        touched = np.uint64(0)
        if left <= right and top <= bottom:
            first, last = np.uint64(math.ceil(left)) // np.uint64(BLOCK), np.uint64(right) // np.uint64(BLOCK)
            row = (np.uint64(2) << last) - (np.uint64(1) << first)
            first, last = np.uint64(math.ceil(top)) // np.uint64(BLOCK), np.uint64(bottom) // np.uint64(BLOCK)
            rows = (~np.uint64(0) >> np.uint64(8) * (np.uint64(7) - last)) & (~np.uint64(0) << np.uint64(8) * first)
            touched = (row * np.uint64(0x0101010101010101)) & rows
        blocks[k] = touched
        g = k * width
        u, v = splat(float32(l11 * dx - l12 * dy)), splat(float32(l22 * dy))
        slopes = select(of_rows, splat(float32(-l12)), splat(float32(l11)))
        store(flat, g + V_ROW, fma(splat(float32(l22)), offsets, v))  # eight lanes too many: overwritten below
        store(flat, g + U_COLUMN, fma(slopes, offsets, select(of_rows, u, splat(float32(0)))))
        row_of = table[k]
        row_of[T_L11], row_of[T_L12], row_of[T_L22] = l11, l12, l22
        row_of[T_LOG2_OPACITY] = geometry[i, LOG2_OPACITY]
        for c in range(np.uint64(n_channels)):
            row_of[np.uint64(VALUES) + c] = channels[i, c]
        row_of[VALUES + n_channels] = depths[i]
        for c in range(VALUES + n_channels + 1, V_ROW + LANES):
            row_of[c] = 0


@helper
def _exponent(flat, g, column, row, u_lanes, v_lanes, log2_opacity):
    """Whitened offsets u and v of the pixels of a block from the Gaussian in a row of the table, and log2 of alpha."""
    u = u_lanes + broadcast(flat, g + U_COLUMN + column) + broadcast(flat, g + U_ROW + row)
    v = v_lanes + broadcast(flat, g + V_ROW + row)
    return u, v, fma(-u, u, fma(-v, v, log2_opacity))


@helper
def _settle(valid, close, geometry, i, x0, y0, block, threshold):
    """The lanes that reach a threshold (log2 of alpha), where those that are ``close`` to it are looked at again."""
    open_bits = bits_of(close)
    kept = lanes_at_least(open_bits, geometry, i, x0, y0, block, threshold)
    return mask_of((bits_of(valid) & ~open_bits) | kept)


@helper
def _start_tile(passed, x0, y0, width, height):
    """Set the transmittance of the pixels of a tile; returns the blocks that have pixels inside the image."""
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
    """Blend every workers-th of some tiles; the pixels of others stay as they are.

    Args:
        tiles: Which tiles, numbered row by row. [K]
        tile_starts, pair_rows: Their pairs, see `cpu_tiles`. [K + 1], [P]
        geometry: Projected Gaussians. [N, 8] float64
        channels, depths: What is blended. [N, D], [N]
        votes: Place of each Gaussian's label among ``names``. [N] int32, or empty
        names: The labels, rising, -1 or more. [L] float32, or empty
        background: One row per pixel, or one for all. [H * W or 1, D]
        limits: Thresholds. [5] float64
        image, alpha, depth: Results. [H, W, D], [H, W], [H, W]
        transmittance: Its end, for the backward pass. [H, W], or empty
        last_pairs: Pairs of the tile that a pixel saw before it was finished, likewise. [H, W] float32, or empty
        ids: Label of each pixel. [H, W], or empty
        tile_ends: One past the last pair that had a pixel left to draw on. [K]
        pair_blocks: The blocks that each pair drew on. [P] uint64
    """
    height, width, n_channels = image.shape
    n_values = padded(n_channels)
    columns = (width + TILE - 1) // TILE
    more, planes = n_values > FIRST, len(names)
    buffer, ballot = aligned(n_values * PIXELS), aligned(planes * PIXELS)
    passed, weights, last = aligned(PIXELS), aligned(PIXELS), aligned(PIXELS)
    covered = aligned(PIXELS)  # sum of weights: unlike 1 - T it is exact where little is covered
    table, blocks = np.zeros((BATCH, VALUES + n_values), np.float32), np.empty(BATCH, np.uint64)
    flat = table.reshape(-1)
    cut, zero = limits[LOG2_ALPHA_MIN], splat(float32(0))
    cut_low, cut_high = splat(float32(cut - CLOSE_LOG2)), splat(float32(cut + CLOSE_LOG2))
    cut_lanes, alpha_max = splat(float32(cut)), splat(float32(limits[ALPHA_MAX]))
    end_low = splat(float32(limits[TRANSMITTANCE_MIN] * (1 - CLOSE_TRANSMITTANCE)))
    end_high = splat(float32(limits[TRANSMITTANCE_MIN] * (1 + CLOSE_TRANSMITTANCE)))
    lane_x, lane_y = load(_X, 0), load(_Y, 0)
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
            _load_batch(begin, end, tile_stop, x0, y0, pair_rows, geometry, channels, depths, votes, table, blocks)
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
                        _, _, exponent = _exponent(flat, g, column, row, u_lanes, v_lanes, log2_opacity)
                        before = load(passed, at)
                        valid = (exponent >= cut_low) & (before > zero)
                        if not any_of(valid):
                            continue
                        if unlikely(any_of(valid & (cut_high > exponent))):
                            i = pair_rows[begin + k]
                            valid = _settle(valid, valid & (cut_high > exponent), geometry, i, x0, y0, block, cut)
                        opaque = select(valid, smaller(exp2(larger(exponent, cut_lanes)), alpha_max), zero)
                        weight = before * opaque
                        after = before - weight
                        ends = valid & (end_high > after)
                        if unlikely(any_of(ends)):
                            close = bits_of(ends & (after >= end_low))
                            if close:
                                pair_blocks[begin + k] = drawn | bit
                                ending = bits_of(ends) ^ close
                                ends = mask_of(ending | lanes_that_finish(
                                    close, geometry, pair_rows, pair_blocks, tile_start, begin + k + 1, x0, y0, block,
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
def padded(n_channels):
    """`padded_values` for kernels."""
    return FIRST + max(0, (n_channels + 1 - FIRST + MORE - 1) // MORE) * MORE


@helper
def _blend_more(drawn, n_values, weights, flat, value, buffer):
    """Add the values beyond the first four of one Gaussian to the blocks ``drawn``."""
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
def _place(channel, block):
    """Where the value of a block's first pixel lies in a tile buffer; that of its next pixel follows."""
    if channel < FIRST:
        return (block * FIRST + channel) * LANES
    chunk = (channel - FIRST) // MORE
    return (FIRST + chunk * MORE) * PIXELS + (block * MORE + channel - FIRST - chunk * MORE) * LANES


@helper
def _finish_tile(
    x0, y0, names, buffer, ballot, passed, covered, last, background, limits, image, alpha, depth, transmittance,
    last_pairs, ids,
):  # fmt: skip
    """Write the pixels of a tile."""
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
        distance = load(buffer, _place(n_channels, block)) / select(covers > zero, covers, one)
        store(pixels, at_depth, select(covers > zero, distance, zero))
        for c in range(n_channels):
            blended = load(buffer, _place(c, block))
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
                store_whole_rows(flat_ids, pixel, width, load(pixels, at_id))
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


@kernel
def blend_backward(
    worker, workers, tile_starts, tile_ends, pair_rows, pair_slots, pair_blocks, geometry, channels, depths, background,
    limits, alpha, depth, transmittance, last_pairs, d_image, d_alpha, d_depth, with_geometry, slots,
):  # fmt: skip
    """Write the gradient slot of every pair of every workers-th tile: moments, the gradients of values, zeros.

    Goes far to near. With s_i the inner product of values and gradient, and B_i what lies behind i as if it were seen
    through nothing, dL/d(alpha_i) = T_i (s_i - B_i) and B_{i-1} = B_i + alpha_i (s_i - B_i), beginning with the inner
    product of background and gradient: one number per pixel serves all channels, and nothing cancels behind opaque
    Gaussians. T_i is found again as T_{i+1} / (1 - alpha_i).

    Args:
        as in `blend`; d_image [H, W, D], d_alpha [H, W] and d_depth [H, W] are the gradients of the results, the
            latter two empty where there is none; with_geometry is whether more than channels want a gradient, or else
            the moments are zero; slots [S, 16 k] the result, see `cpu_projection.MOMENTS`.
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
    cut, cap = limits[LOG2_ALPHA_MIN], limits[LOG2_ALPHA_MAX]
    zero, one = splat(float32(0)), splat(float32(1))
    cut_low, cut_high = splat(float32(cut - CLOSE_LOG2)), splat(float32(cut + CLOSE_LOG2))
    cut_lanes, alpha_max = splat(float32(cut)), splat(float32(limits[ALPHA_MAX]))
    cap_low, cap_high = splat(float32(cap - CLOSE_LOG2)), splat(float32(cap + CLOSE_LOG2))
    lane_x, lane_y = load(_X, 0), load(_Y, 0)
    for tile in range(worker, len(tile_starts) - 1, workers):
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        tile_start, tile_end = tile_starts[tile], tile_ends[tile]
        for pair in range(tile_end, tile_starts[tile + 1]):
            slots[pair_slots[pair]] = 0
        if tile_end == tile_start:
            continue
        _start_backward(
            x0, y0, background, alpha, depth, transmittance, last_pairs, d_image, d_alpha, d_depth, gradient, passed,
            behind, last,
        )  # fmt: skip
        for batch in range((tile_end - tile_start - 1) // BATCH, -1, -1):
            begin = tile_start + batch * BATCH
            end = min(begin + BATCH, tile_end)
            _load_batch(begin, end, end, x0, y0, pair_rows, geometry, channels, depths, no_votes, table, blocks)
            for k in range(end - begin - 1, -1, -1):
                drawn = pair_blocks[begin + k]
                slot = np.int64(pair_slots[begin + k]) * n_slots
                if not drawn:
                    for c in range(0, n_slots, LANES):
                        store(flat_slots, slot + c, zero)
                    continue
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
                    u, v, exponent = _exponent(flat, g, column, row, u_lanes, v_lanes, log2_opacity)
                    valid = (exponent >= cut_low) & (load(last, at) > number)
                    if unlikely(any_of(valid & (cut_high > exponent))):
                        i = pair_rows[begin + k]
                        valid = _settle(valid, valid & (cut_high > exponent), geometry, i, x0, y0, block, cut)
                    opaque = select(valid, smaller(exp2(larger(exponent, cut_lanes)), alpha_max), zero)
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
                    # dL/d(ln alpha); zero where the cap holds, as the capped alpha does not move
                    to_log = weight * gained
                    capped = valid & (exponent >= cap_low)
                    if unlikely(any_of(capped)):
                        i = pair_rows[begin + k]
                        capped = _settle(capped, capped & (cap_high > exponent), geometry, i, x0, y0, block, cap)
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
    """Fill the tile buffers: gradient with respect to each value, transmittance, and what lies behind everything."""
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
                    gradient[np.uint64(_place(c, block)) + lane] = flat_gradient[of + c]
                    seen += flat_gradient[of + c] * flat_background[shown_at + c]
                if len(to_alpha):
                    seen -= to_alpha[pixel]
                if len(to_depth) and flat_alpha[pixel] > 0:
                    per_weight = to_depth[pixel] / flat_alpha[pixel]
                    gradient[np.uint64(_place(n_channels, block)) + lane] = per_weight
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
    """Gradients of one Gaussian's values beyond the first four, summed over the blocks ``drawn``."""
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
