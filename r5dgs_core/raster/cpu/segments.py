"""Kernel for the weights of Gaussians in each segment of an image; see `batches` for tiles, blocks and batches.

It repeats a forward pass near to far, using its record of the blocks of each pair and the last pair of each pixel, and
sums the same weights per segment and tile.
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
    settle,
)
from .exact_thresholds import ALPHA_MAX, BLOCK, BLOCKS, CLOSE_LOG2, LOG2_ALPHA_MIN
from .projection import TILE
from .simd.float32x16 import LANES, broadcast, load, splat, store
from .simd.vectors import any_of, lowest_bit, unlikely

_NONE, _SEVERAL = -1, -2  # no segment, or more than one, in a block


@helper
def _start_tile(x0, y0, segments, last_pairs, places, names, of_pixels, of_blocks, last):
    """Number the segments of a tile from 0: of pixels and of blocks, and their names; return the number of segments.

    ``places`` is -1 for each segment of the image, before and after.
    """
    height, width = segments.shape
    kinds = 0
    for block in range(BLOCKS * BLOCKS):
        left, top = x0 + block % BLOCKS * BLOCK, y0 + block // BLOCKS * BLOCK
        common = np.int32(_NONE)
        for lane in range(LANES):
            x, y, at = left + lane % BLOCK, top + lane // BLOCK, block * LANES + lane
            of_pixels[at], last[at] = _NONE, float32(0)
            if x < width and y < height:
                last[at] = last_pairs[y, x]
                segment = segments[y, x]
                if segment >= 0:
                    if places[segment] < 0:
                        places[segment], names[kinds] = kinds, segment
                        kinds += 1
                    of_pixels[at] = places[segment]
            if lane == 0:
                common = of_pixels[at]
            elif of_pixels[at] != common:
                common = np.int32(_SEVERAL)
        of_blocks[block] = common
    for kind in range(kinds):
        places[names[kind]] = -1
    return kinds


@kernel
def weigh_segments(
    worker, workers, tile_starts, tile_ends, pair_rows, pair_blocks, geometry, depths, limits, last_pairs, segments,
    count, starts, counts, entry_rows, entry_segments, entry_weights,
):  # fmt: skip
    """List the weights of the pairs of every ``workers``-th tile in the tile's segments.

    Args:
        tile_starts, tile_ends, pair_rows, pair_blocks, geometry, depths, limits, last_pairs: Inputs and results of
            `blend.blend`.
        segments: Segment of each pixel, negative for none. [H, W] int32
        count: Number of segments of the image.
        starts: First entry of each tile, with room for one entry per pair and segment of the tile. [tiles]
        counts: Result, number of entries of each tile. [tiles] int64
        entry_rows, entry_segments, entry_weights: Results, the entries: Gaussian, segment, and sum of its weights over
            the segment's pixels in the tile. [E] int32, int32, float32
    """
    columns = (segments.shape[1] + TILE - 1) // TILE
    passed, last, weights = aligned(PIXELS), aligned(PIXELS), aligned(LANES)
    places, names = np.full(count, _NONE, np.int32), np.empty(count, np.int32)
    of_pixels, of_blocks = np.empty(PIXELS, np.int32), np.empty(BLOCKS * BLOCKS, np.int32)
    sums, met = aligned(min(count, PIXELS) * LANES), np.zeros(min(count, PIXELS), np.bool_)
    sums[:] = 0
    no_channels, no_votes = np.empty((len(geometry), 0), np.float32), np.empty(0, np.int32)
    table, blocks = np.zeros((BATCH, VALUES + FIRST), np.float32), np.empty(BATCH, np.uint64)
    flat = table.reshape(-1)
    cut, close = limits[LOG2_ALPHA_MIN], limits[CLOSE_LOG2]
    cut_low, cut_high = splat(float32(cut - close)), splat(float32(cut + close))
    cut_lanes, alpha_max = splat(float32(cut)), splat(float32(limits[ALPHA_MAX]))
    lane_x, lane_y = load(LANE_X, 0), load(LANE_Y, 0)
    for tile in range(worker, len(tile_starts) - 1, workers):
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        kinds = _start_tile(x0, y0, segments, last_pairs, places, names, of_pixels, of_blocks, last)
        passed[:] = 1
        to, begin = starts[tile], tile_starts[tile]
        while begin < tile_ends[tile] and kinds:
            end = min(begin + BATCH, tile_ends[tile])
            load_batch(
                begin, end, tile_ends[tile], x0, y0, pair_rows, geometry, no_channels, depths, no_votes, table, blocks
            )
            for k in range(end - begin):
                touched = pair_blocks[begin + k]
                if not touched:
                    continue
                g, i = k * (VALUES + FIRST), pair_rows[begin + k]
                u_lanes = broadcast(flat, g + T_L11) * lane_x - broadcast(flat, g + T_L12) * lane_y
                v_lanes = broadcast(flat, g + T_L22) * lane_y
                log2_opacity = broadcast(flat, g + T_LOG2_OPACITY)
                number = splat(float32(begin + k - tile_starts[tile]))
                while touched:
                    block = lowest_bit(touched)
                    touched &= touched - np.uint64(1)
                    column, row, at = block & 7, block >> 3, block * LANES
                    _, _, exponent = exponent_at(flat, g, column, row, u_lanes, v_lanes, log2_opacity)
                    valid = (exponent >= cut_low) & (load(last, at) > number)
                    if unlikely(any_of(valid & (cut_high > exponent))):
                        valid = settle(valid, valid & (cut_high > exponent), geometry, i, x0, y0, block, cut)
                    before = load(passed, at)
                    weight = before * opaque_at(valid, exponent, cut_lanes, alpha_max)
                    store(passed, at, before - weight)
                    kind = of_blocks[block]
                    if kind >= 0:
                        store(sums, kind * LANES, weight + load(sums, kind * LANES))
                        met[kind] = True
                    elif kind == _SEVERAL:
                        store(weights, 0, weight)
                        for lane in range(LANES):
                            kind = of_pixels[at + lane]
                            if kind >= 0:
                                sums[kind * LANES + lane] += weights[lane]
                                met[kind] = True
                for kind in range(kinds):
                    if met[kind]:
                        met[kind] = False
                        total = float32(0)
                        for lane in range(kind * LANES, (kind + 1) * LANES):
                            total += sums[lane]
                            sums[lane] = 0
                        if total > 0:
                            entry_rows[to], entry_segments[to], entry_weights[to] = i, names[kind], total
                            to += 1
            begin = end
        counts[tile] = to - starts[tile]
