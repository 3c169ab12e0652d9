"""Convex hull of an object of Gaussians, from support points of its ellipsoids."""

from __future__ import annotations

import numpy as np

from ..motion import rotations
from ..scene.hull_json import MAX_VERTICES
from . import directions

LEVEL = 0.15  # opacity at which the surface of a Gaussian is placed; between 0.1 and 0.25 hulls of objects fit best
_DIRECTIONS = 1024  # directions in which the hull is tight
_CELLS = 48  # most cells along the longest side of an object, for finding its connected part
_AT_ONCE = 1 << 22  # products of Gaussians and directions that are held in memory


def vertices(
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    most: int = MAX_VERTICES,
) -> np.ndarray:
    """Return points whose convex hull encloses the visible part of an object.

    A Gaussian is enclosed up to its surface of opacity `LEVEL`. Fainter Gaussians and those that are not connected
    with the largest part of the object are left out. Points are added in the direction in which the hull of the
    previous points is farthest from the surface.

    Args:
        means: Centres. [N, 3]
        quats: wxyz. [N, 4]
        scales: Standard deviations. [N, 3]
        opacities: Opacities from 0 to 1. [N]
        most: Maximum number of points, at least 4.

    Returns:
        The points; none if no Gaussian reaches `LEVEL`. [V, 3] float64
    """
    solid = np.flatnonzero(opacities > LEVEL)
    if not len(solid):
        return np.zeros((0, 3))
    solid = solid[largest_part(means[solid].astype(np.float64))]
    centers = means[solid].astype(np.float64)
    sigmas = np.sqrt(2 * np.log(opacities[solid].astype(np.float64) / LEVEL))
    frames = rotations.quats_to_rotmats(rotations.normalize(quats[solid].astype(np.float64)))
    axes = frames * (sigmas[:, None] * scales[solid].astype(np.float64))[:, None, :]
    candidates = _support_points(centers, axes, directions.sphere(_DIRECTIONS))
    return candidates[spread(candidates, directions.sphere(_DIRECTIONS), most)]


def largest_part(points: np.ndarray) -> np.ndarray:
    """Mask of the points in the largest set of adjacent occupied cells of a grid. [N, 3] -> [N]

    The size of the cells follows the number of points, so that neighbours of an evenly filled object are adjacent.
    """
    low, high = np.quantile(points, [0.02, 0.98], axis=0)
    side = 1.5 * (high - low).max()
    count = int(np.clip(np.cbrt(len(points)), 4, _CELLS))
    cells = np.floor((points - (low + high) / 2) * count / max(side, 1e-300)).astype(np.int64) + count
    inside = ((cells > 0) & (cells < 2 * count - 1)).all(axis=1)
    counts = np.zeros((2 * count,) * 3, np.int64)
    np.add.at(counts, tuple(cells[inside].T), 1)
    best, most, rest = np.zeros(counts.shape, bool), 0, counts > 0
    while counts[rest].sum() > most:
        seed = np.zeros_like(rest)
        seed[np.unravel_index(np.argmax(counts * rest), rest.shape)] = True
        part = _fill(seed, rest)
        rest &= ~part
        if counts[part].sum() > most:
            best, most = part, counts[part].sum()
    result = np.zeros(len(points), bool)
    result[inside] = best[tuple(cells[inside].T)]
    return result


def _fill(seed: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Allowed cells that are connected with the seed by faces, edges or corners."""
    while True:
        grown = seed
        for axis in range(3):
            grown = grown | np.roll(grown, 1, axis) | np.roll(grown, -1, axis)
        grown = grown & allowed
        if (grown == seed).all():
            return seed
        seed = grown


def _support_points(centers: np.ndarray, axes: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the farthest point of all ellipsoids in each direction.

    Args:
        centers: Centres of the ellipsoids. [N, 3]
        axes: Their half axes, as columns. [N, 3, 3]
        directions: Unit vectors. [D, 3]

    Returns:
        The points. [D, 3]
    """
    found = np.empty((len(directions), 3))
    step = max(1, _AT_ONCE // len(centers))
    for start in range(0, len(directions), step):
        towards = directions[start : start + step]
        along = np.einsum("nij,di->dnj", axes, towards)  # half axes measured along each direction
        lengths = np.linalg.norm(along, axis=2)
        rows = np.argmax(towards @ centers.T + lengths, axis=1)
        own = np.arange(len(towards))
        unit = along[own, rows] / np.maximum(lengths[own, rows], 1e-300)[:, None]
        found[start : start + step] = centers[rows] + np.einsum("dij,dj->di", axes[rows], unit)
    return found


def spread(points: np.ndarray, directions: np.ndarray, most: int) -> np.ndarray:
    """Return rows of points that approximate the support function of all of them. Greedy. [V]"""
    heights = points @ directions.T
    support = heights.max(axis=0)
    tolerance = 1e-6 * np.ptp(points, axis=0).max()
    rows = [int(np.argmax(heights[:, 0]))]
    reached = heights[rows[0]]
    while len(rows) < most:
        worst = int(np.argmax(support - reached))
        if support[worst] - reached[worst] <= tolerance:
            break
        rows.append(int(np.argmax(heights[:, worst])))
        reached = np.maximum(reached, heights[rows[-1]])
    return np.array(rows)
