"""Joints between two parts of one object: how one part moves relative to another.

Notation: a part with pivot p is in the pose (R, d) relative to the bind state, x -> p + R (x - p) + d. The motion of a
part relative to its parent is a map of the bind state about the joint's point j, x -> j + Q (x - j) + s, followed by
the parent's motion. A closed hinge or ball has s = 0, a closed slider Q = I.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from . import models, rotations, se3
from .models import MotionModel

HINGE, BALL, SLIDER = KINDS = ("hinge", "ball", "slider")
# Vectors of a motion model that move the joint's point, and those that turn the part.
_CENTERS = (
    "velocity",
    "acceleration",
    "center_offset",
    "offset_displacement",
    "second_velocity",
    "second_acceleration",
)
_TURNS = (
    "angular_velocity",
    "angular_acceleration",
    "offset_rotvec",
    "precession",
    "second_angular_velocity",
    "second_angular_acceleration",
)


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint, in the world at t_max.

    Attributes:
        kind: One of `KINDS`.
        point: Point j; it stays where it is in the parent, except for a slider. [3]
        axis: Unit vector, of a hinge or a slider; None for a ball. [3]
        limits: Smallest and largest observed coordinate, 0 at t_max: the angle about the axis, rad, or the distance
            along it, world units. None for a ball.
        model: Motion relative to the parent past t_max, about ``point``.
        stop_time: Time past t_max at which the coordinate reaches a limit and stays there, or None.
    """

    kind: str
    point: np.ndarray
    axis: np.ndarray | None
    limits: tuple[float, float] | None
    model: MotionModel
    stop_time: float | None = None

    def poses(self, tau: float | np.ndarray) -> se3.Pose:
        """Motion relative to the parent at times past t_max, about the point. [...] -> [..., 4], [..., 3]"""
        return models.evaluate(self.model, tau if self.stop_time is None else np.minimum(tau, self.stop_time))

    def transformed(self, turn: np.ndarray, scale: float, shift: np.ndarray) -> Joint:
        """Joint after the similarity x -> scale turn x + shift of the world; a negative scale mirrors.

        Args:
            turn: Rotation. [3, 3]
            scale: Scale of lengths.
            shift: Translation. [3]
        """
        limits = self.limits
        if limits is not None and self.kind == SLIDER:
            limits = abs(scale) * limits[0], abs(scale) * limits[1]
        axis = None if self.axis is None else turn @ self.axis
        if axis is not None and self.kind == SLIDER and scale < 0:
            axis = -axis
        point, model = scale * turn @ self.point + shift, self.model.transformed(turn, scale)
        return replace(self, point=point, axis=axis, limits=limits, model=model)

    def text(self) -> str:
        """Joint in words, such as "hinge, -40 to 55 degrees"."""
        if self.limits is None:
            return self.kind
        low, high = np.degrees(self.limits) if self.kind == HINGE else self.limits
        return f"{self.kind}, " + (
            f"{low:.0f} to {high:.0f} degrees" if self.kind == HINGE else f"{low:.3g} to {high:.3g}"
        )


def relative(
    parent: se3.Pose, parent_pivot: np.ndarray, child: se3.Pose, pivot: np.ndarray, point: np.ndarray
) -> se3.Pose:
    """Motion of a child relative to its parent, about a point.

    Args:
        parent: Poses of the parent, about its pivot. [..., 4], [..., 3]
        parent_pivot: [3]
        child: Poses of the child, about its pivot. [..., 4], [..., 3]
        pivot: Its pivot. [3]
        point: The point. [3]
    """
    back = rotations.conjugate(parent[0])
    moved = child[1] + _turned(child[0], point - pivot) - parent[1]
    return rotations.normalize(rotations.multiply(back, child[0])), rotations.rotate(back, moved) + _turned(
        back, point - parent_pivot
    )


def composed(
    parent: se3.Pose, parent_pivot: np.ndarray, own: se3.Pose, point: np.ndarray, pivot: np.ndarray
) -> se3.Pose:
    """Inverse of `relative`: pose of the child, about its pivot, from its motion ``own`` relative to the parent."""
    moved = own[1] + _turned(own[0], pivot - point)
    turned = parent[1] + moved + _turned(parent[0], pivot + moved - parent_pivot)
    return rotations.normalize(rotations.multiply(parent[0], own[0])), turned


def _turned(quats: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """Displacements of the ends of arms by rotations, exactly zero without rotation. [..., 4], [..., 3] -> [..., 3]"""
    return rotations.rotate(quats, arms + 0 * quats[..., 1:]) - arms


def closed(kind: str, axis: np.ndarray | None, model: MotionModel) -> MotionModel:
    """Return the nearest motion model, about the joint's point, that keeps a joint closed."""
    along = np.zeros((3, 3)) if axis is None else np.outer(axis, axis)
    held = {HINGE: (0 * along, along), BALL: (along, np.eye(3)), SLIDER: (along, 0 * along)}[kind]
    changes = {
        name: linear @ getattr(model, name)
        for names, linear in zip((_CENTERS, _TURNS), held, strict=True)
        for name in names
    }
    return replace(model, **changes)
