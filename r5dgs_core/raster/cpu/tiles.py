"""Kernels for sorting Gaussians by depth and assigning them to the tiles that they touch.

A pair is a Gaussian in a tile. Pairs are stored tile by tile, near to far within each. Slots number the same pairs
Gaussian by Gaussian, so that gradients are written per pair and summed per Gaussian in a fixed order.
"""

from __future__ import annotations

import math

import numpy as np

from ..compilation import helper, kernel
from ..thread_pool import run_parts, threads
from .projection import (
    BOX_DIGIT,
    BOX_MARGIN,
    EXTENT_X,
    EXTENT_Y,
    GEOMETRY,
    L11,
    L12,
    L22,
    MAX_TILES,
    MEAN_X,
    MEAN_Y,
    TILE,
)
from .simd.vectors import prefetch

_BOX_BITS = np.uint64(BOX_DIGIT.bit_length() - 1)
AHEAD = 16  # prefetch distance, Gaussians
_DIGIT = 11  # bits per pass of the radix sort
_WORTH_A_THREAD = 4000  # Gaussians per thread
_MAX_PAIRS = (1 << 31) - 1  # slots are numbered in int32
_MAX_PAIRS_OF_A_TILE = 1 << 24  # pairs of a tile are numbered in float32


def sort_by_depth(depths, radii):
    """Sort the rows with a radius by increasing depth (float64), ties in row order. -> [V] int32"""
    with np.errstate(over="ignore"):  # depths beyond float32 sort last, then by float64
        bits = depths.astype(np.float32).view(np.uint32)
    parts = max(1, min(threads(), len(bits) // _WORTH_A_THREAD))
    # Each part sorts a range of depths; the bounds do not affect the result.
    bounds = np.zeros(parts + 1, np.int64)
    bounds[-1] = 1 << 32
    if parts > 1:
        step = max(1, len(bits) // 1024)
        sample = np.append(np.sort(bits[::step][radii[::step] > 0]), bounds[-1])
        bounds[1:-1] = sample[np.arange(1, parts) * len(sample) // parts]
    order, counts = np.empty(len(bits), np.int32), np.empty(parts, np.int64)
    run_parts(sort_part, parts, bits, depths, radii, bounds, order, counts)
    return order[: counts.sum()]


@kernel
def sort_part(worker, workers, bits, depths, radii, bounds, order, counts):
    """Write the rows with a radius whose depths lie in this worker's range, sorted, to their part of ``order``.

    The bits of positive floats sort like the floats. A radix sort of the float32 depths, least significant digit first,
    skips leading digits that are all equal. Runs of equal float32 depths are then sorted by float64 depth.

    Args:
        bits: Bits of the float32 depths. [n] uint32
        depths, radii: See `projection.project`. [n]
        bounds: Start of each range of bits, and the end of the last. [workers + 1] int64
        order: Result; the caller cuts it to the sum of ``counts``. [n] int32
        counts: Result, number of rows of each worker. [workers] int64
    """
    low, high = bounds[worker], bounds[worker + 1]
    before, count, least, most = 0, 0, high, low
    for i in range(np.uint64(len(bits))):
        if radii[i] > 0:
            depth = np.int64(bits[i])
            before += depth < low
            if low <= depth < high:
                count += 1
                least, most = min(least, depth), max(most, depth)
    items, spare = np.empty(count, np.uint64), np.empty(count, np.uint64)  # key above, row below
    at = 0
    for i in range(np.uint64(len(bits))):
        depth = np.int64(bits[i])
        if radii[i] > 0 and low <= depth < high:
            items[at] = np.uint64(depth - least) << np.uint64(32) | i
            at += 1
    starts = np.empty((1 << _DIGIT) + 1, np.int64)
    digit_mask, shift = np.uint64((1 << _DIGIT) - 1), np.uint64(32)
    while count and np.uint64(most - least) >> (shift - np.uint64(32)):
        starts[:] = 0
        for k in range(np.uint64(count)):
            starts[(items[k] >> shift & digit_mask) + np.uint64(1)] += 1
        for digit in range(1 << _DIGIT):
            starts[digit + 1] += starts[digit]
        for k in range(np.uint64(count)):
            digit = items[k] >> shift & digit_mask
            spare[np.uint64(starts[digit])] = items[k]
            starts[digit] += 1
        items, spare = spare, items
        shift += np.uint64(_DIGIT)
    part = order[before : before + count]
    for k in range(np.uint64(count)):
        part[k] = np.int32(items[k] & np.uint64(0xFFFFFFFF))
    begin = np.int64(0)
    for k in range(np.int64(1), count + 1):
        if k == count or items[k] >> np.uint64(32) != items[begin] >> np.uint64(32):
            if k - begin > 1:
                _sort_run(part, begin, k, depths)
            begin = k
    counts[worker] = count


@helper
def _sort_run(order, begin, end, depths):
    """Sort a few rows by depth, then by row. Shell sort, fast on sorted input."""
    gap = 1
    while gap < (end - begin) // 3:
        gap = 3 * gap + 1
    while gap:
        for k in range(begin + gap, end):
            row, at = order[k], k
            while at - gap >= begin:
                other = order[at - gap]
                if not (depths[row] < depths[other] or (depths[row] == depths[other] and row < other)):
                    break
                order[at] = other
                at -= gap
            order[at] = row
        gap //= 3


@helper
def _tile_range(low, high, tiles):
    """First and one past the last tile with pixel centres between two coordinates in px, within 0 .. tiles."""
    first = math.floor((max(low, 0.0) - 0.5) / TILE)
    last = math.floor((min(high, float(tiles * TILE)) - 0.5) / TILE)
    return max(int(first), 0), min(int(last) + 1, tiles)


@helper
def _box(boxes, i):
    """Tiles of the bounding box of Gaussian i: first and one past the last column, then the same of rows."""
    packed, mask = np.uint64(boxes[i]), np.uint64(MAX_TILES)
    left, packed = packed & mask, packed >> _BOX_BITS
    right, packed = packed & mask, packed >> _BOX_BITS
    return np.int64(left), np.int64(right), np.int64(packed & mask), np.int64(packed >> _BOX_BITS)


@helper
def _span(geometry, i, row, columns):
    """First and one past the last tile column that the ellipse of Gaussian i touches in a tile row."""
    x, y = geometry[i, MEAN_X], geometry[i, MEAN_Y]
    extent_x, extent_y = geometry[i, EXTENT_X], geometry[i, EXTENT_Y]
    shift, ratio = geometry[i, L12] / geometry[i, L11], geometry[i, L22] / geometry[i, L11]
    tip = shift * extent_y * extent_y / extent_x  # dy at the point of the ellipse with the largest dx
    low = max(row * TILE + 0.5 - y, -extent_y)
    high = min(row * TILE + TILE - 0.5 - y, extent_y)
    right = min(max(tip, low), high)
    left = min(max(-tip, low), high)
    x_high = shift * right + ratio * math.sqrt(max(extent_y * extent_y - right * right, 0.0))
    x_low = shift * left - ratio * math.sqrt(max(extent_y * extent_y - left * left, 0.0))
    first, last = _tile_range(x + x_low - BOX_MARGIN, x + x_high + BOX_MARGIN, columns)
    return first, max(first, last)


@kernel
def count_pairs(worker, workers, order, boxes, geometry, columns, tile_counts, slot_counts):
    """Count the pairs of this worker's part of ``order``.

    Args:
        order: Rows of the visible Gaussians, near to far. [V]
        boxes, geometry: Projected Gaussians, see `projection.project`. [N], [N, 8]
        columns: Number of tile columns.
        tile_counts: Result, number of pairs per tile, one row per worker. [workers, tiles] int64
        slot_counts: Result, number of pairs of Gaussian i at index i + 1. [N + 1] int64, or empty
    """
    counts, flat_geometry = tile_counts[worker], geometry.reshape(-1)
    counts[:] = 0
    for rank in range(len(order) * worker // workers, len(order) * (worker + 1) // workers):
        if rank + AHEAD < len(order):  # depth order accesses memory at random
            coming = np.int64(order[rank + AHEAD])
            prefetch(boxes, coming)
            prefetch(flat_geometry, coming * GEOMETRY)
            prefetch(slot_counts, coming)
        i = order[rank]
        left, right, top, bottom = _box(boxes, i)
        first, last, slots = left, right, 0
        trimmed = right - left > 1 and bottom - top > 1
        for row in range(top, bottom):
            if trimmed:
                first, last = _span(geometry, i, row, columns)
            slots += last - first
            for column in range(first, last):
                counts[row * columns + column] += 1
        if len(slot_counts):
            slot_counts[i + 1] = slots


@kernel
def fill_pairs(worker, workers, order, boxes, geometry, columns, cursors, slot_starts, pair_rows, pair_slots):
    """Write the pairs counted by `count_pairs`; ``cursors`` holds the first pair of each worker in each tile."""
    cursor, flat_geometry = cursors[worker], geometry.reshape(-1)
    for rank in range(len(order) * worker // workers, len(order) * (worker + 1) // workers):
        if rank + AHEAD < len(order):  # depth order accesses memory at random
            coming = np.int64(order[rank + AHEAD])
            prefetch(boxes, coming)
            prefetch(flat_geometry, coming * GEOMETRY)
            prefetch(slot_starts, coming)
        i = order[rank]
        left, right, top, bottom = _box(boxes, i)
        first, last = left, right
        trimmed = right - left > 1 and bottom - top > 1
        slot = slot_starts[i] if len(slot_starts) else 0
        for row in range(top, bottom):
            if trimmed:
                first, last = _span(geometry, i, row, columns)
            for column in range(first, last):
                pair = cursor[row * columns + column]
                cursor[row * columns + column] += 1
                pair_rows[pair] = i
                if len(pair_slots):
                    pair_slots[pair] = slot
                    slot += 1


def assign_tiles(order, boxes, geometry, width, height, with_slots):
    """List the pairs of depth-sorted Gaussians and tiles.

    Args:
        order: Rows of the visible Gaussians, near to far. [V] int32
        boxes, geometry: Projected Gaussians, see `projection.project`. [N], [N, 8]
        width, height: Size of the image, px.
        with_slots: True if gradients are needed.

    Returns:
        tile_starts: Pairs of tile t are tile_starts[t] : tile_starts[t + 1]; tiles row by row. [tiles + 1] int64
        pair_rows: Row of ``geometry``. [P] int32
        pair_slots: Slot of the pair. [P] int32, or empty
        slot_starts: Slots of Gaussian i are slot_starts[i] : slot_starts[i + 1]. [N + 1] int64, or empty
    """
    columns, rows = -(-width // TILE), -(-height // TILE)
    parts = max(1, min(threads(), len(order) // _WORTH_A_THREAD))
    slot_starts = np.zeros(len(geometry) + 1 if with_slots else 0, np.int64)
    counts = np.empty((parts, columns * rows), np.int64)
    run_parts(count_pairs, parts, order, boxes, geometry, columns, counts, slot_starts)
    np.cumsum(slot_starts, out=slot_starts)
    tile_starts = np.zeros(columns * rows + 1, np.int64)
    np.cumsum(counts.sum(0), out=tile_starts[1:])
    if tile_starts[-1] > _MAX_PAIRS or np.diff(tile_starts).max(initial=0) > _MAX_PAIRS_OF_A_TILE:
        raise ValueError(
            f"means: {len(order)} Gaussians touch {tile_starts[-1]} tiles in all, more than can be counted; remedy: "
            "draw smaller images, or fewer Gaussians that cover all of it"
        )
    cursors = tile_starts[:-1] + np.cumsum(counts, 0) - counts
    pair_rows = np.empty(tile_starts[-1], np.int32)
    pair_slots = np.empty(tile_starts[-1] if with_slots else 0, np.int32)
    run_parts(fill_pairs, parts, order, boxes, geometry, columns, cursors, slot_starts, pair_rows, pair_slots)
    return tile_starts, pair_rows, pair_slots, slot_starts


@kernel
def merge_pairs(worker, workers, depths, ranks, spans, rows, other_spans, other_rows, merged_starts, merged_rows):
    """Merge two lists of pairs, tile by tile, both near to far.

    Args:
        depths: Depths of all rows. [n]
        ranks: At equal depth, the row with the lower rank is nearer. [n] int64
        spans, rows: First and one past the last pair of each tile, and the rows of the pairs. [K, 2], [P]
        other_spans, other_rows: The same of the other list.
        merged_starts: First merged pair of each tile. [K + 1]
        merged_rows: Result.
    """
    tiles = len(merged_starts) - 1
    for tile in range(tiles * worker // workers, tiles * (worker + 1) // workers):
        a, a_end, b, b_end = spans[tile, 0], spans[tile, 1], other_spans[tile, 0], other_spans[tile, 1]
        for at in range(merged_starts[tile], merged_starts[tile + 1]):
            first = b == b_end
            if a < a_end and b < b_end:
                row, other = rows[a], other_rows[b]
                first = depths[row] < depths[other] or (depths[row] == depths[other] and ranks[row] < ranks[other])
            if first:
                merged_rows[at] = rows[a]
                a += 1
            else:
                merged_rows[at] = other_rows[b]
                b += 1
