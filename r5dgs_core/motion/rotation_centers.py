"""Centre and axis of the rotation or oscillation of a motion model at t_max, and edits of both.

Notation: points are relative to the group's pivot, along the world axes.
"""

from __future__ import annotations

import numpy as np

from . import rotations
from .models import KINDS, MotionModel


def center(model: MotionModel) -> np.ndarray | None:
    """Point about which a motion rotates or oscillates at t_max, or None if it has none. [3]"""
    return KINDS[model.kind].center(model)


def axis(model: MotionModel) -> np.ndarray | None:
    """Unit vector of the rotation axis at t_max or of the starting rotation; None if the motion does not rotate. [3]"""
    if not KINDS[model.kind].spins(model):
        return None
    spin = model.angular_velocity if model.angular_velocity.any() else model.angular_acceleration
    length = float(np.linalg.norm(spin))
    return spin / length if length > 0 else None


def with_center(model: MotionModel, point: np.ndarray, old: np.ndarray | None = None) -> MotionModel:
    """Move the centre of a motion to another point.

    Args:
        model: The motion.
        point: New centre. [3]
        old: Point on the axis of a twist that moves to ``point``, or None for `center`. [3]

    Raises:
        ValueError: The motion has no centre.
    """
    now = center(model)
    if now is None:
        raise ValueError(f"expected a motion with a centre, got one of kind {model.kind!r}")
    return KINDS[model.kind].with_center(model, np.asarray(point, np.float64), now if old is None else old)


def with_axis(model: MotionModel, direction: np.ndarray, through: np.ndarray | None = None) -> MotionModel:
    """Change the direction of a motion's axis, keeping one point of it and the angular speed.

    Args:
        model: The motion.
        direction: Not zero, of any length. [3]
        through: Point on the axis of a twist that is kept, or None for `center`. [3]

    Raises:
        ValueError: The motion does not rotate, or the direction is zero.
    """
    old = axis(model)
    length = float(np.linalg.norm(direction))
    if old is None or not 0 < length < np.inf:
        raise ValueError(f"expected a rotating motion and a direction, got one of kind {model.kind!r} and {direction}")
    turn = rotations.between_vectors(old, np.asarray(direction, np.float64) / length)
    return KINDS[model.kind].with_axis(model, turn, through)
