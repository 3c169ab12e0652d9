"""Gaussians inside a lasso or under a brush, as seen from a view, and those in front of others."""

from __future__ import annotations

import numpy as np

FRONT = 0.5  # a Gaussian is in front if those in front of it transmit at least this share of its light
_DEPTH_BITS, _MIN_DEPTH_BITS = 32, 20  # resolution of depths in sorting
_FINEST = 4.0  # smallest cell in which Gaussians hide each other, in pixels


def project(positions: np.ndarray, matrix: np.ndarray, width: int, height: int) -> tuple[np.ndarray, ...]:
    """Project points into a region.

    Args:
        positions: Points. [n, 3]
        matrix: From the points' frame to clip space. [4, 4]
        width: Width of the region in pixels.
        height: Height of the region in pixels.

    Returns:
        Pixels from the lower left corner, NaN behind the view [n, 2]; depths, which increase away from it [n]; and
        homogeneous coordinates, by which sizes are divided [n].
    """
    clip = positions.astype(np.float64) @ matrix[:, :3].T + matrix[:, 3]
    ahead = clip[:, 3] > 1e-12
    w = np.where(ahead, clip[:, 3], np.nan)
    pixels = (clip[:, :2] / w[:, None] + 1) * 0.5 * (width, height)
    return pixels, clip[:, 2] / w, w


def within(pixels: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Mask of the pixels inside a rectangle; by column, which is faster than a reduction of rows. [n, 2] -> [n]"""
    x, y = pixels[:, 0], pixels[:, 1]
    return (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])


def in_lasso(pixels: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Mask of the pixels inside a closed path by the even-odd rule.

    The pixels are sorted by height once, so that each edge only visits those beside it.

    Args:
        pixels: Points. [n, 2]
        path: Corners; the last one is joined to the first. [k, 2]

    Returns:
        The mask. [n]
    """
    inside = np.zeros(len(pixels), bool)
    if len(path) < 3:
        return inside
    low, high = path.min(0), path.max(0)
    near = np.flatnonzero(within(pixels, low, high))
    near = near[np.argsort(pixels[near, 1])]
    x, y, parity = pixels[near, 0], pixels[near, 1], np.zeros(len(near), bool)
    for (x0, y0), (x1, y1) in zip(path, np.roll(path, -1, axis=0), strict=True):
        if y0 == y1:
            continue
        first, last = np.searchsorted(y, (min(y0, y1), max(y0, y1)))
        crossing = x0 + (y[first:last] - y0) * ((x1 - x0) / (y1 - y0))
        parity[first:last] ^= x[first:last] < crossing
    inside[near[parity]] = True
    return inside


def under_brush(pixels: np.ndarray, path: np.ndarray, radius: float) -> np.ndarray:
    """Mask of the pixels within a distance of a path. [n, 2], [k, 2] -> [n]"""
    inside = np.zeros(len(pixels), bool)
    rows = np.flatnonzero(within(pixels, path.min(0) - radius, path.max(0) + radius))
    rows = rows[np.argsort(pixels[rows, 1])]
    places, hit = pixels[rows], np.zeros(len(rows), bool)
    ends = (path[:-1], path[1:]) if len(path) > 1 else (path, path)
    for start, stop in zip(*ends, strict=True):
        low, high = min(start[1], stop[1]) - radius, max(start[1], stop[1]) + radius
        near = slice(*np.searchsorted(places[:, 1], (low, high)))
        along, arms = stop - start, places[near] - start
        share = np.clip(arms @ along / max(float(along @ along), 1e-12), 0, 1)
        hit[near] |= ((arms - share[:, None] * along) ** 2).sum(1) <= radius**2
    inside[rows[hit]] = True
    return inside


def is_in_front(pixels: np.ndarray, depths: np.ndarray, opacities: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Mask of the Gaussians that are visible through those in front of them.

    The picture is divided into square cells, as large as most Gaussians. In each cell, Gaussians are passed from front
    to back; one is visible until the light of those before it falls below `FRONT`.

    Args:
        pixels: Centres; NaN for those that are not seen. [n, 2]
        depths: Depths, increasing away from the view. [n]
        opacities: Opacities. [n]
        sizes: Standard deviations in pixels. [n]

    Returns:
        The mask. [n]
    """
    front = np.zeros(len(pixels), bool)
    seen = np.flatnonzero(np.isfinite(pixels[:, 0]) & np.isfinite(pixels[:, 1]))
    if not len(seen):
        return front
    cell = max(_FINEST, 2 * float(np.median(sizes[seen])))
    columns, rows = (np.floor(pixels[seen, axis] / cell).astype(np.int64) for axis in (0, 1))
    columns -= columns.min()
    keys = (rows - rows.min()) * (columns.max() + 1) + columns
    order = _by_cell_and_depth(keys, depths[seen])
    covered = np.minimum((np.pi * 4 / cell**2) * np.square(sizes[seen]), 1.0) * opacities[seen]
    light = np.log1p(-np.minimum(covered, 0.999))[order]
    before = np.cumsum(light) - light
    ordered = keys[order]
    starts = np.flatnonzero(np.diff(ordered, prepend=ordered[0] - 1))
    before -= np.repeat(before[starts], np.diff(starts, append=len(order)))
    front[seen[order]] = before >= np.log(FRONT) - 1e-9
    return front


def _by_cell_and_depth(keys: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Rows sorted by cell, then by depth.

    Cell, depth and row are packed into one integer, if they fit, because sorting values is faster than sorting rows.

    Args:
        keys: Cells, from 0. [n]
        depths: Depths. [n]
    """
    row_bits, key_bits = len(keys).bit_length(), int(keys.max()).bit_length()
    depth_bits = min(63 - row_bits - key_bits, _DEPTH_BITS)
    if depth_bits < _MIN_DEPTH_BITS:
        return np.lexsort((depths, keys))
    ahead = depths - depths.min()
    steps = (ahead * ((1 << depth_bits) - 1) / max(float(ahead.max()), 1e-300)).astype(np.int64)
    packed = (((keys << depth_bits) | steps) << row_bits) | np.arange(len(keys))
    packed.sort()
    return packed & ((1 << row_bits) - 1)
