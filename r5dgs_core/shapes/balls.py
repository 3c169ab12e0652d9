"""Balls among objects.

The Gaussians of an object also fill the space behind it that no camera sees, such as that between a ball and the table
on which it lies. The ball is the one that most tangent planes touch; those of such parts do not count.
"""

from __future__ import annotations

import numpy as np

from ..scene.hull_json import MAX_VERTICES
from . import directions

_SOFT = 0.01  # deviation, as a share of the radius, from which on planes count less
_ROUNDS = (8.0, 4.0, 2.0, 1.0)  # factors of it, one fit after another, so that the first guess does not matter
_ALIKE = 0.03  # median deviation, as a share of the radius, up to which an object is a ball; that of a cube is 0.05
_WHOLE = 0.04  # the same including the side of what sticks out; `_ALIKE` holds for the other side
_FLAT = 0.2  # share of the planes that may be closer to the centre by more: a hemisphere is no ball


def of(normals: np.ndarray, reach: np.ndarray) -> np.ndarray | None:
    """Return corners of a polyhedron with the volume of the ball that an object is nearly, or None.

    Args:
        normals: Outward unit normals of planes that touch the object. [P, 3]
        reach: Their distances from the origin along the normals. [P]

    Returns:
        Corners, all at one distance from the centre. [V, 3]
    """
    from scipy.optimize import least_squares
    from scipy.spatial import ConvexHull

    columns = np.append(normals, np.ones((len(normals), 1)), axis=1)
    x = np.linalg.lstsq(columns, reach, rcond=None)[0]
    if x[3] <= 0:
        return None
    middle, scale = x[:3], float(x[3])
    shifted, x = (reach - normals @ middle) / scale, np.array([0.0, 0.0, 0.0, 1.0])
    for factor in _ROUNDS:
        x = least_squares(lambda y: columns @ y - shifted, x, loss="cauchy", f_scale=factor * _SOFT).x
    if not _is_ball(normals, columns @ x - shifted):
        return None
    corners = directions.sphere(MAX_VERTICES)
    radius = float(x[3]) * np.cbrt(4 / 3 * np.pi / ConvexHull(corners).volume)
    return middle + scale * (x[:3] + radius * corners)


def _is_ball(normals: np.ndarray, deviations: np.ndarray) -> bool:
    """Return True if planes touch a ball, except on one side. [P, 3], [P]

    Gaussians in the space that no camera sees stick out on one side, the longer end of an egg on two.
    """
    beyond = normals.T @ np.maximum(-deviations, 0.0)
    apart = np.abs(deviations)
    alike = np.median(apart) <= _ALIKE or (
        np.median(apart) <= _WHOLE and np.median(apart[normals @ beyond <= 0]) <= _ALIKE
    )
    return bool(alike and np.mean(deviations > _ALIKE) <= _FLAT)
