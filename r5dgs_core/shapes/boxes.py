"""Boxes among convex hulls.

The intersection of silhouettes bulges over the faces of a box, because hardly any picture looks exactly along a face: a
box cannot stand or land on such a hull. Everywhere else, the hull reaches as far as the box.
"""

from __future__ import annotations

import itertools

import numpy as np

from ..motion import rotations
from . import directions

_DIRECTIONS = directions.sphere(256)
_GUESSES = 200  # rotations to start from
_SOFT = 0.01  # deviation, as a share of the mean reach, from which on directions count less: those of bulges
_ALIKE = 0.035  # mean deviation, as a share of the mean reach, up to which a hull is a box; that of a cylinder is 0.06
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def of(vertices: np.ndarray) -> np.ndarray | None:
    """Return the corners of the box that a convex hull is nearly, or None.

    Args:
        vertices: Vertices of the hull, which is not flat. [V, 3]

    Returns:
        Corners. [8, 3]
    """
    from scipy.optimize import least_squares

    middle = vertices.mean(axis=0)
    reach = (_DIRECTIONS @ (vertices - middle).T).max(axis=1)
    scale = float(reach.mean())
    start, first = _guess(reach)

    def unpacked(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        turn = rotations.multiply(rotations.rotvecs_to_quats(x[:3]), start)
        return scale * x[3:6], rotations.quats_to_rotmats(turn), scale * np.exp(x[6:])

    def deviations(x: np.ndarray) -> np.ndarray:
        center, axes, halves = unpacked(x)
        return (_DIRECTIONS @ center + np.abs(_DIRECTIONS @ axes) @ halves - reach) / scale

    x = np.concatenate([np.zeros(3), first[:3] / scale, np.log(np.maximum(first[3:] / scale, 1e-3))])
    x = least_squares(deviations, x, loss="soft_l1", f_scale=_SOFT).x
    if np.abs(deviations(x)).mean() > _ALIKE:
        return None
    center, axes, halves = unpacked(x)
    return middle + center + (_CORNERS * halves) @ axes.T


def _guess(reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [4] of the best of many boxes, and its centre and half edge lengths [6], by least squares."""
    turns = rotations.normalize(np.random.default_rng(0).normal(size=(_GUESSES, 4)))
    columns = np.abs(_DIRECTIONS @ rotations.quats_to_rotmats(turns))
    columns = np.concatenate([np.broadcast_to(_DIRECTIONS, columns.shape), columns], axis=2)
    found = np.linalg.pinv(columns) @ reach
    best = int(np.argmin(np.abs(columns @ found[..., None] - reach[:, None]).mean(axis=(1, 2))))
    return turns[best], found[best]
