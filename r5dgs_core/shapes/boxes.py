"""Boxes among objects.

The intersection of silhouettes bulges over the faces of a box, because hardly any picture looks exactly along a face: a
box cannot stand or land on such a hull. The planes at the outlines of the silhouettes touch the box itself.
"""

from __future__ import annotations

import itertools

import numpy as np

from ..motion import rotations
from . import directions

_DIRECTIONS = directions.sphere(256)
_GUESSES, _THINNED = 200, 3  # rotations to start from; every third plane is enough to compare them
_HOPELESS = 0.15  # mean deviation of the best guess, as a share of the mean reach, of which no fit makes a box
_SOFT = 0.01  # deviation, as a share of the mean reach, from which on planes count less
_ALIKE = 0.035  # mean deviation, as a share of the mean reach, up to which an object is a box; that of a can is 0.06
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def of_hull(vertices: np.ndarray) -> np.ndarray | None:
    """Return the corners of the box that a convex hull with vertices [V, 3] is nearly, or None. [8, 3]"""
    return of(_DIRECTIONS, (_DIRECTIONS @ vertices.T).max(axis=1))


def of(normals: np.ndarray, reach: np.ndarray) -> np.ndarray | None:
    """Return the corners of the box that an object is nearly, or None.

    Args:
        normals: Outward unit normals of planes that touch the object. [P, 3]
        reach: Their distances from the origin along the normals. [P]

    Returns:
        Corners. [8, 3]
    """
    from scipy.optimize import least_squares

    middle = np.linalg.lstsq(normals, reach, rcond=None)[0]
    reach = reach - normals @ middle
    scale = float(reach.mean())
    start, first, missed = _guess(normals[::_THINNED], reach[::_THINNED])
    if missed > _HOPELESS * scale:
        return None

    def unpacked(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        turn = rotations.multiply(rotations.rotvecs_to_quats(x[:3]), start)
        return scale * x[3:6], rotations.quats_to_rotmats(turn), scale * np.exp(x[6:])

    def deviations(x: np.ndarray) -> np.ndarray:
        center, axes, halves = unpacked(x)
        return (normals @ center + np.abs(normals @ axes) @ halves - reach) / scale

    x = np.concatenate([np.zeros(3), first[:3] / scale, np.log(np.maximum(first[3:] / scale, 1e-3))])
    x = least_squares(deviations, x, loss="soft_l1", f_scale=_SOFT).x
    if np.abs(deviations(x)).mean() > _ALIKE:
        return None
    center, axes, halves = unpacked(x)
    return middle + center + (_CORNERS * halves) @ axes.T


def _guess(normals: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation [4] of the best of many boxes, its centre and half edges [6], and its mean deviation."""
    turns = rotations.normalize(np.random.default_rng(0).normal(size=(_GUESSES, 4)))
    columns = np.abs(normals @ rotations.quats_to_rotmats(turns))
    columns = np.concatenate([np.broadcast_to(normals, columns.shape), columns], axis=2)
    found = np.linalg.pinv(columns) @ reach
    missed = np.abs((columns @ found[..., None])[..., 0] - reach).mean(axis=1)
    best = int(np.argmin(missed))
    return turns[best], found[best], float(missed[best])
