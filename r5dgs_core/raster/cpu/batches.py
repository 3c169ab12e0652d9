"""Common parts of the blending kernels: tiles, blocks, and the tile-local table of pairs.

A tile is processed in blocks of 4 x 4 pixels, one vector each (`float32x16`), numbered row by row. The blocks that a
Gaussian may touch are the set bits of one integer. Tile buffers store the values of a block together: the first four
(channels, then depth, then zeros), then further ones in groups of eight. Pairs are copied to a small tile-local table
in batches. The copies are independent, so their cache misses overlap, and the data is in cache afterwards.

With (x, y) the position of a lane in its block, the whitened offset from the centre of the Gaussian is
u = (l11 x - l12 y) + a term per block column + a term per block row, and v = l22 y + a term per block row. All terms
are relative to the middle of the tile, where they are computed in float64, and are small wherever the Gaussian is
visible.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32

from ..compilation import helper
from .exact_thresholds import BLOCK, BLOCKS, lanes_at_least
from .projection import EXTENT_X, EXTENT_Y, GEOMETRY, L11, L12, L22, LOG2_OPACITY, MEAN_X, MEAN_Y, TILE
from .simd.float32x16 import LANES, broadcast, exp2, load, mask_of, splat, store
from .simd.vectors import bits_of, fma, larger, prefetch, select, smaller

PIXELS = TILE * TILE
BATCH = 64  # pairs per copy to the table
AHEAD = 12  # prefetch distance, pairs
FIRST = 4  # values blended in the first sweep
MORE = 8  # values per chunk of the second sweep

# Columns of the tile-local table: terms of u per block column and block row, of v per block row, then the parameters of
# the Gaussian and its values.
U_COLUMN, U_ROW, V_ROW = 0, BLOCKS, 2 * BLOCKS
T_L11, T_L12, T_L22, T_LOG2_OPACITY = (3 * BLOCKS + i for i in range(4))
VALUES = 3 * BLOCKS + 4

_OFFSETS = np.array([BLOCK * (b % BLOCKS - 0.5 * BLOCKS) + 0.5 for b in range(LANES)], np.float32)
_OF_ROWS = np.array([b // BLOCKS for b in range(LANES)], np.float32)  # 0 for columns, 1 for rows
LANE_X = np.array([lane % BLOCK for lane in range(LANES)], np.float32)
LANE_Y = np.array([lane // BLOCK for lane in range(LANES)], np.float32)


@helper
def padded(n_channels):
    """Number of blended values: the channels, depth, and zeros as padding."""
    return FIRST + max(0, (n_channels + 1 - FIRST + MORE - 1) // MORE) * MORE


@helper
def aligned(count):
    """Allocate float32 values aligned to a vector, so that loads and stores never cross cache lines."""
    array = np.empty(count + LANES, np.float32)
    skip = (-array.ctypes.data // 4) % LANES
    return array[skip : skip + count]


@helper
def load_batch(begin, end, stop, x0, y0, pair_rows, geometry, channels, depths, votes, table, blocks):
    """Copy pairs begin : end of a tile to rows of ``table``, and the blocks that their boxes touch to ``blocks``.

    The data of pairs up to ``stop`` is prefetched, as it is scattered in memory.
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
        # pixel centres lie at +0.5; a margin of 0.01 px, as rounding must not lose a pixel
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
        store(flat, g + V_ROW, fma(splat(float32(l22)), offsets, v))  # writes eight lanes too many, overwritten below
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
def exponent_at(flat, g, column, row, u_lanes, v_lanes, log2_opacity):
    """Whitened offsets u and v of the pixels of a block from the Gaussian in a table row, and log2 of alpha."""
    u = u_lanes + broadcast(flat, g + U_COLUMN + column) + broadcast(flat, g + U_ROW + row)
    v = v_lanes + broadcast(flat, g + V_ROW + row)
    return u, v, fma(-u, u, fma(-v, v, log2_opacity))


@helper
def settle(valid, close, geometry, i, x0, y0, block, threshold):
    """Mask of the lanes that reach a threshold (log2 of alpha); lanes in ``close`` are decided again in float64."""
    open_bits = bits_of(close)
    kept = lanes_at_least(open_bits, geometry, i, x0, y0, block, threshold)
    return mask_of((bits_of(valid) & ~open_bits) | kept)


@helper
def place_of(channel, block):
    """Index of the value of a block's first pixel in a tile buffer; the block's other pixels follow."""
    if channel < FIRST:
        return (block * FIRST + channel) * LANES
    chunk = (channel - FIRST) // MORE
    return (FIRST + chunk * MORE) * PIXELS + (block * MORE + channel - FIRST - chunk * MORE) * LANES


@helper
def opaque_at(valid, exponent, least, most):
    """Alpha of the valid lanes from log2 of alpha, capped at ``most``; 0 in the others.

    Exponents below ``least`` (that of alpha_min) belong to invalid lanes; raising them avoids subnormal numbers.
    """
    return select(valid, smaller(exp2(larger(exponent, least)), most), splat(float32(0)))
