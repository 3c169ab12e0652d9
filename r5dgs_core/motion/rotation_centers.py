"""About which point and axis a motion turns or swings at t_max, and the same motion about another.

Notation: points are seen from the group's pivot, along the world's axes. A "ballistic_spin" carries its center u. The
velocities of a twist are v + w x x at x, and their rates a + eps x x: its center is the point nearest to the pivot that
moves along the axis only, c = w x v / |w|^2, and the whole field of velocities goes where the center goes. A
"translation" that swings with W rests at a / W^2. What flies straight, stays or tumbles freely has no such point.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from . import rotations
from .models import MotionModel

_TWISTS = ("constant_twist", "world_twist")


def center(model: MotionModel) -> np.ndarray | None:
    """The point about which a motion turns or swings at t_max, or None where it has none. [3]"""
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
    """Unit vector about which a motion turns at t_max, or starts to turn; None where it does not turn. [3]"""
    if not model.turns or model.kind in ("static", "translation"):
        return None
    spin = model.angular_velocity if model.angular_velocity.any() else model.angular_acceleration
    length = float(np.linalg.norm(spin))
    return spin / length if length > 0 else None


def with_center(model: MotionModel, point: np.ndarray, old: np.ndarray | None = None) -> MotionModel:
    """The same motion about another point.

    Args:
        model: The motion.
        point: Where it is moved to. [3]
        old: Which point of the axis of a twist goes there, None for `center`. [3]

    Raises:
        ValueError: The motion has no such point.
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
    """The same motion about an axis of another direction through the same point; its speed of turning stays.

    Args:
        model: The motion.
        direction: Not zero, of any length. [3]
        through: Which point of the axis of a twist stays on it, None for `center`. [3]

    Raises:
        ValueError: The motion does not turn, or the direction is zero.
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
    """A twist whose rates at the pivot are those that it had off it. [3]"""
    return replace(
        model,
        velocity=model.velocity + np.cross(model.angular_velocity, by),
        acceleration=model.acceleration + np.cross(model.angular_acceleration, by),
    )


def _between(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Shortest rotation from one unit vector to another, unit wxyz; a half turn about any normal of opposite ones."""
    quat = np.array([1 + old @ new, *np.cross(old, new)])
    if np.linalg.norm(quat) < 1e-7:
        normal = np.cross(old, np.eye(3)[int(np.argmin(np.abs(old)))])
        quat = np.array([0.0, *normal])
    return rotations.normalize(quat)
