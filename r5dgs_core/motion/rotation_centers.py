"""Centre and axis of the rotation or oscillation of a motion model at t_max, and edits of both.

Notation: points are relative to the group's pivot, along the world axes. A "ballistic_spin" stores its centre u. The
velocity of a twist at x is v + w x x, with rate a + eps x x; its centre is the point nearest to the pivot that moves
only along the axis, c = w x v / |w|^2, and the whole velocity field moves with it. A "translation" that oscillates with
W is centred at a / W^2. Steady translations, static groups and free tops have no centre.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from . import rotations
from .models import MotionModel

_TWISTS = ("constant_twist", "world_twist")


def center(model: MotionModel) -> np.ndarray | None:
    """Point about which a motion rotates or oscillates at t_max, or None if it has none. [3]"""
    if model.kind == "ballistic_spin":
        return model.center_offset
    if model.kind == "translation" and model.frequency > 0:
        return model.acceleration / model.frequency**2
    if model.kind in _TWISTS and model.angular_velocity.any():
        w = model.angular_velocity
        length = np.linalg.norm(w)
        return np.cross(w / length, model.velocity / length)
    return None


def axis(model: MotionModel) -> np.ndarray | None:
    """Unit vector of the rotation axis at t_max or of the starting rotation; None if the motion does not rotate. [3]"""
    if not model.turns or model.kind in ("static", "translation"):
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
        raise ValueError(f"expected a motion that turns or swings about a point, got {model.kind!r} that has none")
    if model.kind == "ballistic_spin":
        return replace(model, center_offset=point)
    if model.kind == "translation":
        return replace(model, acceleration=model.frequency**2 * np.asarray(point, np.float64))
    return _moved(model, (now if old is None else old) - np.asarray(point, np.float64))


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
        raise ValueError(f"expected a motion that turns and a direction, got {model.kind!r} and {direction}")
    turn = _between(old, np.asarray(direction, np.float64) / length)
    spins = {
        "angular_velocity": rotations.rotate(turn, model.angular_velocity),
        "angular_acceleration": rotations.rotate(turn, model.angular_acceleration),
    }
    if model.kind not in _TWISTS:
        return replace(model, **spins)
    at = center(model) if through is None else through
    at = np.zeros(3) if at is None else at
    there = _moved(model, at)
    velocity, acceleration = rotations.rotate(turn, there.velocity), rotations.rotate(turn, there.acceleration)
    return _moved(replace(model, **spins, velocity=velocity, acceleration=acceleration), -at)


def _moved(model: MotionModel, by: np.ndarray) -> MotionModel:
    """Shift a twist so that its rates at the pivot are those it had at ``by``. [3]"""
    return replace(
        model,
        velocity=model.velocity + np.cross(model.angular_velocity, by),
        acceleration=model.acceleration + np.cross(model.angular_acceleration, by),
    )


def _between(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Shortest rotation between two unit vectors, unit wxyz; a half turn about any normal if they are opposite."""
    quat = np.array([1 + old @ new, *np.cross(old, new)])
    if np.linalg.norm(quat) < 1e-7:
        normal = np.cross(old, np.eye(3)[int(np.argmin(np.abs(old)))])
        quat = np.array([0.0, *normal])
    return rotations.normalize(quat)
