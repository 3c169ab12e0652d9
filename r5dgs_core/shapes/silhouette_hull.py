"""Convex hull of an object of Gaussians, from its silhouettes.

The centres of Gaussians lie inside of an object, and faint ones form a fringe around it. Both leave no trace in a
hull that has the outlines of the object's pictures.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..scene.hull_json import MAX_VERTICES
from . import convex_hull, directions, silhouettes
from .silhouettes import Silhouette


class SilhouetteHull(NamedTuple):
    """A hull and its error.

    Attributes:
        vertices: Points whose convex hull it is. [V, 3] float64
        error: Mean distance of its outlines from the silhouettes, world units.
    """

    vertices: np.ndarray
    error: float


def of(
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    most: int = MAX_VERTICES,
) -> SilhouetteHull | None:
    """Return the intersection of the cylinders above the convex silhouettes, reduced to a number of vertices.

    The reduced hull is scaled to the volume of the intersection.

    Args:
        means: Centres. [N, 3]
        quats: wxyz. [N, 4]
        scales: Standard deviations. [N, 3]
        opacities: Opacities from 0 to 1. [N]
        most: Maximum number of vertices, at least 4.

    Returns:
        The hull; None if no picture of the Gaussians reaches half opacity.
    """
    found = silhouettes.of(means, quats, scales, opacities)
    if not found:
        return None
    corners = _intersection(found)
    if corners is None:
        return None
    vertices = corners[convex_hull.spread(corners, directions.sphere(1024), most)]
    vertices = _with_volume_of(vertices, corners)
    return None if vertices is None else SilhouetteHull(vertices, error(vertices, found))


def _intersection(found: list[Silhouette]) -> np.ndarray | None:
    """Corners of the polytope inside of all silhouettes, or None if there is none. [P, 3]"""
    from scipy.optimize import linprog
    from scipy.spatial import HalfspaceIntersection, QhullError

    towards, reach = silhouettes.tangents(found)
    middle = np.linalg.lstsq(towards, reach, rcond=None)[0]
    reach = reach - towards @ middle
    size = np.abs(reach).max()
    planes = np.append(towards, np.ones((len(reach), 1)), axis=1)
    inner = linprog([0, 0, 0, -1], A_ub=planes, b_ub=reach / size, bounds=[(None, None)] * 4)
    if inner.status != 0 or inner.x[3] <= 1e-6:  # the silhouettes contradict each other
        return None
    planes[:, 3] = -reach / size
    try:
        corners = HalfspaceIntersection(planes, inner.x[:3]).intersections
    except QhullError:
        return None
    return corners * size + middle


def _with_volume_of(vertices: np.ndarray, corners: np.ndarray) -> np.ndarray | None:
    """Scale a hull about its middle to the volume of another one; None if it is flat."""
    from scipy.spatial import ConvexHull, QhullError

    middle = vertices.mean(axis=0)
    size = np.ptp(vertices, axis=0).max()
    try:
        own, wanted = (ConvexHull((points - middle) / size).volume for points in (vertices, corners))
    except QhullError:
        return None
    return middle + np.cbrt(wanted / own) * (vertices - middle)


def error(vertices: np.ndarray, found: list[Silhouette]) -> float:
    """Return the mean ratio of the area between outlines of a hull and silhouettes to the length of the outlines."""
    sides = directions.circle(silhouettes.SIDES)
    areas, lengths = [], []
    for one in found:
        reach = (vertices @ one.basis.T @ sides.T).max(axis=0)
        x, y = (low + one.step * np.arange(count) for low, count in zip(one.corner, one.mask.shape, strict=True))
        inside = (x[:, None, None] * sides[:, 0] + y[None, :, None] * sides[:, 1] <= reach).all(axis=2)
        areas.append((inside != one.mask).sum() * one.step**2)
        lengths.append(2 * np.pi * reach.mean())  # Cauchy's formula; the position of the origin cancels
    return float(np.sum(areas) / np.sum(lengths))
