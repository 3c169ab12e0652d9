"""Rotation centre and axis of kinds whose points move with the velocity field of a twist.

The velocity of a twist at a point y is v + w x y, and its rate a + eps x y. Its centre is the point nearest to the
pivot that moves only along the axis, c = w x v / |w|^2, and the whole velocity field moves with it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import rotations
from .base import MotionKind, MotionModel


class Twist(MotionKind):
    """Base class of `constant_twist` and `world_twist`."""

    center_on_axis = True

    def center(self, model: MotionModel) -> np.ndarray | None:
        if not model.angular_velocity.any():
            return None
        w = model.angular_velocity
        length = np.linalg.norm(w)
        return np.cross(w / length, model.velocity / length)

    def with_center(self, model: MotionModel, point: np.ndarray, old: np.ndarray) -> MotionModel:
        return _moved(model, old - point)

    def with_axis(self, model: MotionModel, turn: np.ndarray, through: np.ndarray | None) -> MotionModel:
        at = self.center(model) if through is None else through
        at = np.zeros(3) if at is None else at
        there = _moved(model, at)
        rates = {name: rotations.rotate(turn, getattr(there, name)) for name in ("velocity", "acceleration")}
        return _moved(replace(super().with_axis(model, turn, through), **rates), -at)


def _moved(model: MotionModel, by: np.ndarray) -> MotionModel:
    """Shift a twist so that its rates at the pivot are those it had at ``by``. [3]"""
    return replace(
        model,
        velocity=model.velocity + np.cross(model.angular_velocity, by),
        acceleration=model.acceleration + np.cross(model.angular_acceleration, by),
    )
