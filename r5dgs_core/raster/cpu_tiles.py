"""Kernels that sort Gaussians by depth once and hand them out to the tiles that they touch.

A pair is a Gaussian in a tile. Pairs lie tile after tile, near to far within each; the slot of a pair numbers the same
pairs Gaussian after Gaussian, so that gradients can be written per pair and summed per Gaussian in a fixed order.
"""

from __future__ import annotations

import math

import numpy as np

from .compile import kernel
from .cpu_projection import EXTENT_X, EXTENT_Y, L11, L22, MEAN_X, MEAN_Y, SHIFT

TILE = 32  # px; larger tiles make fewer pairs, smaller ones finish earlier where scenes are opaque

_DIGIT = 11  # bits per pass of the radix sort
_MARGIN = 0.01  # px added to the extents, far more than rounding takes away; exact decisions come later


@kernel
def sort_by_depth(depths, radii):
    """Rows with a radius, by increasing depth, rows of equal depth in their order. -> [V] int32

    The bits of positive floats are ordered like the floats: a radix sort with three passes, least digit first.
    """
    count = 0
    for i in range(len(depths)):
        if radii[i] > 0:
            count += 1
    order, spare = np.empty(count, np.int32), np.empty(count, np.int32)
    bits = depths.view(np.uint32)
    count = 0
    for i in range(len(depths)):
        if radii[i] > 0:
            order[count] = i
            count += 1
    starts = np.empty((1 << _DIGIT) + 1, np.int64)
    for shift in range(0, 32, _DIGIT):
        starts[:] = 0
        for k in range(count):
            starts[((bits[order[k]] >> np.uint32(shift)) & np.uint32((1 << _DIGIT) - 1)) + 1] += 1
        for digit in range(1 << _DIGIT):
            starts[digit + 1] += starts[digit]
        for k in range(count):
            digit = (bits[order[k]] >> np.uint32(shift)) & np.uint32((1 << _DIGIT) - 1)
            spare[starts[digit]] = order[k]
            starts[digit] += 1
        order, spare = spare, order
    return order


@kernel
def _tile_range(low, high, tiles):
    """First and one past the last tile that has pixel centres between two coordinates in px, within 0 .. tiles."""
    first = math.floor((max(low, 0.0) - 0.5) / TILE)
    last = math.floor((min(high, float(tiles * TILE)) - 0.5) / TILE)
    return max(int(first), 0), min(int(last) + 1, tiles)


@kernel
def assign_tiles(order, n, geometry, width, height):
    """List the pairs of depth-ordered Gaussians and tiles.

    Args:
        order: Row of each visible Gaussian among all n, near to far. [V]
        geometry: Projected Gaussians, near to far. [V, 8]
        width, height: Size of the image, px.

    Returns:
        tile_starts: Pairs of tile t are tile_starts[t] : tile_starts[t + 1]; tiles row by row. [tiles + 1] int64
        pair_ranks: Row of ``geometry``. [P] int32
        pair_slots: Slot of the pair. [P] int32
        slot_starts: Slots of Gaussian i, not of rank i, are slot_starts[i] : slot_starts[i + 1]. [n + 1] int64
    """
    columns, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    visible = len(order)
    # The span of tiles in each row of tiles is computed once and stored: rounding twice could count differently.
    row_starts = np.zeros(visible + 1, np.int64)
    first_rows = np.empty(visible, np.int32)
    for rank in range(visible):
        y, extent = np.float64(geometry[rank, MEAN_Y]), np.float64(geometry[rank, EXTENT_Y]) + _MARGIN
        first, last = _tile_range(y - extent, y + extent, rows)
        first_rows[rank] = first
        row_starts[rank + 1] = row_starts[rank] + max(last - first, 0)
    span_first, span_last = np.empty(row_starts[visible], np.int32), np.empty(row_starts[visible], np.int32)
    tile_starts = np.zeros(columns * rows + 1, np.int64)
    slot_starts = np.zeros(n + 1, np.int64)
    for rank in range(visible):
        x, y = np.float64(geometry[rank, MEAN_X]), np.float64(geometry[rank, MEAN_Y])
        extent_x, extent_y = np.float64(geometry[rank, EXTENT_X]), np.float64(geometry[rank, EXTENT_Y])
        shift = np.float64(geometry[rank, SHIFT])
        ratio = np.float64(geometry[rank, L22]) / np.float64(geometry[rank, L11])
        tip = shift * extent_y * extent_y / extent_x  # dy of the point of the ellipse with the largest dx
        slots = 0
        for k in range(row_starts[rank], row_starts[rank + 1]):
            row = first_rows[rank] + k - row_starts[rank]
            low = max(row * TILE + 0.5 - y, -extent_y)
            high = min(row * TILE + TILE - 0.5 - y, extent_y)
            right = min(max(tip, low), high)
            left = min(max(-tip, low), high)
            x_high = shift * right + ratio * math.sqrt(max(extent_y * extent_y - right * right, 0.0))
            x_low = shift * left - ratio * math.sqrt(max(extent_y * extent_y - left * left, 0.0))
            first, last = _tile_range(x + x_low - _MARGIN, x + x_high + _MARGIN, columns)
            last = max(last, first)
            span_first[k], span_last[k] = first, last
            slots += last - first
            for column in range(first, last):
                tile_starts[row * columns + column + 1] += 1
        slot_starts[order[rank] + 1] = slots
    for tile in range(columns * rows):
        tile_starts[tile + 1] += tile_starts[tile]
    for i in range(n):
        slot_starts[i + 1] += slot_starts[i]

    cursors = tile_starts[:-1].copy()
    pair_ranks, pair_slots = np.empty(slot_starts[n], np.int32), np.empty(slot_starts[n], np.int32)
    for rank in range(visible):
        slot = slot_starts[order[rank]]
        for k in range(row_starts[rank], row_starts[rank + 1]):
            row = first_rows[rank] + k - row_starts[rank]
            for column in range(span_first[k], span_last[k]):
                pair = cursors[row * columns + column]
                cursors[row * columns + column] += 1
                pair_ranks[pair] = rank
                pair_slots[pair] = slot
                slot += 1
    return tile_starts, pair_ranks, pair_slots, slot_starts
