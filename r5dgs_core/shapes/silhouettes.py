"""Silhouettes of an object of Gaussians in parallel projections.

The order of Gaussians along a ray does not change their joint opacity 1 - prod(1 - a_i exp(-d_i^2 / 2)), so a picture
of it is a sum of logarithms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..motion import rotations
from . import convex_hull, directions

LEVEL = 0.45  # opacity at the outline; between 0.3 and 0.5, hulls of objects fit best
VIEWS = 16  # 24 views of 64 cells fit no better and take twice the time
SIDES = 48  # directions in a picture in which the outline is measured
CELLS = 48  # along the longer side of the box of the middle 98 % of the centres, with its margin
_MARGIN = 0.15  # of that box, on each side
_BLUR = 0.3  # least standard deviation of a Gaussian, cells
_FAINT = 0.01  # opacity that is not drawn
_AT_ONCE = 1 << 20  # cells of Gaussians that are held in memory
_WINDOWS = np.array([1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96])  # half sides of drawn squares, cells


@dataclass(frozen=True)
class Silhouette:
    """One silhouette.

    Attributes:
        basis: Axes of the picture. [2, 3]
        corner: Position of cell (0, 0) along the axes, world units. [2]
        step: Side of a cell, world units.
        mask: Cells inside. [X, Y] bool
        sides: Farthest position of the outline along each direction of `directions.circle(SIDES)`. [SIDES]
    """

    basis: np.ndarray
    corner: np.ndarray
    step: float
    mask: np.ndarray
    sides: np.ndarray


def of(
    means: np.ndarray, quats: np.ndarray, scales: np.ndarray, opacities: np.ndarray, level: float = LEVEL
) -> list[Silhouette]:
    """Return the silhouettes in which the Gaussians reach an opacity: their largest connected part each.

    Args:
        means: Centres. [N, 3]
        quats: wxyz. [N, 4]
        scales: Standard deviations. [N, 3]
        opacities: Opacities from 0 to 1. [N]
        level: Opacity at the outline.
    """
    seen = np.flatnonzero(opacities > _FAINT)
    if not len(seen):
        return []
    seen = seen[convex_hull.largest_part(means[seen].astype(np.float64))]
    centers = means[seen].astype(np.float64)
    axes = rotations.quats_to_rotmats(rotations.normalize(quats[seen].astype(np.float64)))
    axes = axes * scales[seen].astype(np.float64)[:, None, :]
    views = directions.sphere(2 * VIEWS)[:VIEWS]
    drawn = (_silhouette(centers, axes, opacities[seen], towards, level) for towards in views)
    return [one for one in drawn if one is not None]


def tangents(found: list[Silhouette]) -> tuple[np.ndarray, np.ndarray]:
    """Return the planes that touch an object at the outlines of its silhouettes.

    Returns:
        Their outward unit normals [P, 3], and the distances of the planes from the origin along them. [P]
    """
    normals = np.concatenate([directions.circle(SIDES) @ one.basis for one in found])
    return normals, np.concatenate([one.sides for one in found])


def _silhouette(
    centers: np.ndarray, axes: np.ndarray, opacities: np.ndarray, towards: np.ndarray, level: float
) -> Silhouette | None:
    """Silhouette along a direction, or None. Columns of ``axes`` [N, 3, 3] are the scaled axes of the Gaussians."""
    basis = _basis(towards)
    points, flat = centers @ basis.T, np.einsum("ai,nij->naj", basis, axes)
    covariances = np.einsum("naj,nbj->nab", flat, flat)
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    spread = np.sqrt(np.median(np.trace(covariances, axis1=1, axis2=2)))
    side = max((high - low).max(), spread)
    low, high = low - _MARGIN * side - 2 * spread, high + _MARGIN * side + 2 * spread
    step = (high - low).max() / CELLS
    shape = tuple(np.ceil((high - low) / step).astype(int) + 1)
    alpha = _draw((points - low) / step, covariances / step**2, opacities, shape)
    mask = _largest_part(alpha >= level)
    if mask is None:
        return None
    outline = _crossings(np.where(mask | (alpha < level), alpha, 0.0), mask, level)
    if len(outline) < 6:
        return None
    sides = (outline * step + low) @ directions.circle(SIDES).T
    return Silhouette(basis, low, step, mask, sides.max(axis=0))


def _basis(towards: np.ndarray) -> np.ndarray:
    """Two axes at right angles to a unit vector. [2, 3]"""
    across = np.cross(towards, np.eye(3)[np.argmin(np.abs(towards))])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(towards, across)])


def _draw(points: np.ndarray, covariances: np.ndarray, opacities: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Joint opacity of 2D Gaussians at the integer points of a picture; all lengths in cells. [X, Y]"""
    covariances = covariances + _BLUR**2 * np.eye(2)
    reach = np.sqrt(2 * np.log(np.maximum(opacities / _FAINT, 1.0)))
    radius = reach * np.sqrt(np.maximum(covariances[:, 0, 0], covariances[:, 1, 1]))
    a, b, c = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    inverse = (np.stack([c, -2 * b, a]) / (a * c - b * b) * -0.5).astype(np.float32)  # of x x, x y and y y
    base = np.floor(points).astype(np.int64)
    offset, strength = (points - base).astype(np.float32), np.minimum(opacities, 0.99).astype(np.float32)
    far = (base < -radius[:, None]) | (base > np.array(shape) + radius[:, None])
    far |= radius[:, None] > _WINDOWS[-1]  # a larger one is no part of the object
    bucket = np.where(far.any(axis=1), len(_WINDOWS), np.searchsorted(_WINDOWS, radius))
    # No window needs to be cut: centres are up to a window's half side off the picture, and the window reaches as far.
    rim = 2 * int(_WINDOWS[bucket[bucket < len(_WINDOWS)]].max(initial=0)) + 2
    width = shape[1] + 2 * rim
    total = np.zeros((shape[0] + 2 * rim) * width)
    first = (base[:, 0] + rim) * width + base[:, 1] + rim
    for k, half in enumerate(_WINDOWS):
        rows, ticks = np.flatnonzero(bucket == k), np.arange(-half, half + 2)
        count = max(1, _AT_ONCE // len(ticks) ** 2)
        window = (ticks[:, None] * width + ticks).ravel()
        for start in range(0, len(rows), count):
            chosen = rows[start : start + count]
            x, y = (ticks.astype(np.float32) - offset[chosen, axis, None] for axis in (0, 1))
            power = (inverse[0, chosen, None] * x**2)[:, :, None] + (inverse[2, chosen, None] * y**2)[:, None, :]
            power += (inverse[1, chosen, None] * x)[:, :, None] * y[:, None, :]
            np.exp(power, out=power)
            power *= -strength[chosen, None, None]
            power += 1
            np.log(power, out=power)
            cells = first[chosen, None] + window
            total += np.bincount(cells.ravel(), power.ravel(), minlength=len(total))
    total = total.reshape(-1, width)[rim : rim + shape[0], rim : rim + shape[1]]
    return 1 - np.exp(total)


def _largest_part(mask: np.ndarray) -> np.ndarray | None:
    """Largest set of cells that are connected by their sides; None if the mask is empty. [X, Y] bool"""
    from scipy import ndimage

    labels = np.zeros(mask.shape, np.int32)
    if ndimage.label(mask, output=labels) == 0:
        return None
    return labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])


def _crossings(alpha: np.ndarray, mask: np.ndarray, level: float) -> np.ndarray:
    """Points at which the opacity passes a level between adjacent cells, interpolated linearly, in cells. [P, 2]"""
    found = []
    for axis in (0, 1):
        a, inside = np.moveaxis(alpha, axis, 0), np.moveaxis(mask, axis, 0)
        i, j = np.nonzero(inside[1:] != inside[:-1])
        along = i + (level - a[i, j]) / (a[i + 1, j] - a[i, j])
        found.append(np.stack([along, j] if axis == 0 else [j, along], axis=1))
    return np.concatenate(found)
