"""Convex bodies: faces, mass properties at uniform density, and a flat foot to stand on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import errors

STANDS = 0.15  # of the size: distance from the ground up to which a body stands on it; others are held by something
FOOT = 0.03  # of the size: height of the lowest layer of a hull that is pressed flat
_MOST_FOOT = 0.12
_MOST_OF_HEIGHT = 0.25  # the same as a share of the height of a hull that is thin
_ROUND = 0.045  # deviation of the distances of a ball's vertices from its centre, over their mean, at most
_FULL = 0.8  # volume of a ball's hull over that of the ball through its vertices, at least
_MARGIN = 0.02  # of the size: distance of the centre of mass from the border of the foot


@dataclass(frozen=True)
class Solid:
    """Convex body of density 1.

    Attributes:
        vertices: The corners. [V, 3]
        triangles: Rows of ``vertices``, counter-clockwise as seen from outside. [T, 3]
        volume: Volume, which is its mass.
        center: Centre of mass. [3]
        inertia: About the centre, in the axes of the vertices. [3, 3]
    """

    vertices: np.ndarray
    triangles: np.ndarray
    volume: float
    center: np.ndarray
    inertia: np.ndarray

    @property
    def normals(self) -> np.ndarray:
        """Outward unit normals of the F triangles that are no lines. [F, 3]"""
        a, b, c = np.moveaxis(self.vertices[self.triangles], 1, 0)
        normals = np.cross(b - a, c - a)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        rows = lengths[:, 0] > 1e-12 * self.size**2
        return normals[rows] / lengths[rows]

    @property
    def size(self) -> float:
        """Longest side of its box."""
        return float(np.ptp(self.vertices, axis=0).max())

    @property
    def ball_radius(self) -> float | None:
        """Radius of the ball of equal volume if the body is nearly a ball, whose facets would keep it from rolling."""
        distances = np.linalg.norm(self.vertices - self.center, axis=1)
        radius = float(np.cbrt(3 * self.volume / (4 * np.pi)))
        full = radius**3 > _FULL * distances.mean() ** 3
        return radius if full and distances.std() < _ROUND * distances.mean() else None


def of(points: np.ndarray) -> Solid:
    """Return the convex hull of points [P, 3]. Raises ConfigError if they lie in a plane, to 1e-9 of their size."""
    from scipy.spatial import ConvexHull, QhullError

    points = np.asarray(points, np.float64)
    if len(points) < 4:
        raise errors.ConfigError(f"a hull needs at least 4 points, found {len(points)}")
    middle = points.mean(axis=0)
    size = max(np.ptp(points, axis=0).max(), 1e-300)
    try:
        found = ConvexHull((points - middle) / size)
    except (QhullError, ValueError) as error:
        raise errors.ConfigError("the points of a hull lie in a plane") from error
    numbers = np.full(len(points), -1)
    numbers[found.vertices] = np.arange(len(found.vertices))
    corners, triangles = found.points[found.vertices], numbers[found.simplices]
    a, b, c = np.moveaxis(corners[triangles], 1, 0)
    inward = (np.cross(b - a, c - a) * found.equations[:, :3]).sum(axis=1) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    volume, center, inertia = mass_properties(corners[triangles])
    if volume < 1e-9:
        raise errors.ConfigError("the points of a hull lie in a plane")
    return Solid(corners * size + middle, triangles, volume * size**3, center * size + middle, inertia * size**5)


def mass_properties(corners: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, centre of mass and inertia about it, from tetrahedra between the origin and triangles. [T, 3, 3]"""
    volumes = np.linalg.det(corners) / 6
    volume = volumes.sum()
    center = (volumes[:, None] * corners.sum(axis=1)).sum(axis=0) / (4 * volume)
    corners = corners - center
    volumes, total = np.linalg.det(corners) / 6, corners.sum(axis=1)
    second = np.einsum("t,tki,tkj->ij", volumes, corners, corners) + np.einsum("t,ti,tj->ij", volumes, total, total)
    second /= 20  # integral of x x^T
    return float(volume), center, np.trace(second) * np.eye(3) - second


def with_flat_foot(vertices: np.ndarray, up: np.ndarray, foot: float = FOOT) -> tuple[np.ndarray, float]:
    """Press the lowest part of a hull flat, so that the body rests where it was observed to rest.

    The bottom of an object is seldom seen, so its hull ends in a corner, on which the body would tip over. A layer of
    ``foot`` times the size is cut off, and the vertices within such a layer above it are moved onto the cut. The layer
    grows up to `_MOST_FOOT` until the centre of mass is well above the foot. It is at most a quarter of the height.

    Args:
        vertices: Corners of a hull. [V, 3]
        up: Unit normal of the support. [3]
        foot: Height of the layer, in sizes.

    Returns:
        Points whose convex hull is the new one [V, 3], and the height of its foot along ``up``: the height of the
        plane on which this body rests.

    Raises:
        ConfigError: The hull is flat.
    """
    size, tall = float(np.ptp(vertices, axis=0).max()), float(np.ptp(vertices @ up))
    most = min(_MOST_FOOT, _MOST_OF_HEIGHT * tall / max(size, 1e-300))
    foot = min(foot, most)
    heights, flat = vertices @ up, np.linalg.svd(up[None])[2][1:]
    while True:
        floor = float(heights.min()) + foot * size
        low = heights < floor + foot * size
        pressed = vertices + np.where(low, floor - heights, 0.0)[:, None] * up
        if foot >= most or _inside(flat @ of(pressed).center, pressed[low] @ flat.T) > _MARGIN * size:
            return pressed, floor
        foot = min(1.25 * foot, most)


def _inside(point: np.ndarray, corners: np.ndarray) -> float:
    """Distance of a point [2] from the border of a convex polygon with corners [V, 2]; negative outside."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        sides = ConvexHull(corners).equations
    except (QhullError, ValueError):  # fewer than three corners
        return -np.inf
    return float(-(sides[:, :2] @ point + sides[:, 2]).max())
