"""A body that moves along knots: poses with rates before and after them, which differ at impacts.

Notation: between two knots with poses (Q0, d0), (Q1, d1), a time h apart, d is the cubic with the velocities of the
knots, and R = exp(r) Q0 with r the cubic from 0 to log(Q1 Q0^-1) whose slopes are the angular velocities of the knots,
V(r)^-1 w with V of `se3`. After the last knot, the body moves on with the rates after it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .. import cubic_curves, rotations, se3
from ..knots import PLACE, QUAT, SPIN, TIME, VELOCITY
from .base import Curve, MotionKind, MotionModel


class Trajectory(MotionKind):
    """R_f and d_f through the knots of the model."""

    label = "Trajectory"
    tooltip = "Moves along stored knots, such as those of a prediction with contacts"
    word = "contact"
    needs_knots = True

    def curve(self, model: MotionModel, tau: np.ndarray, most_steps: int | None) -> Curve:
        knots = _knots(model)
        number = np.searchsorted(knots[:, TIME], tau, side="right") - 1
        last = len(knots) - 1
        inside = between(knots[np.clip(number, 0, last)], knots[np.clip(number + 1, 0, last)], tau)
        outside = _beyond(knots[np.clip(number, 0, last)], tau, (number >= 0)[..., None])
        within = ((number >= 0) & (number < last))[..., None]
        quats, places, spins, velocities = (np.where(within, x, y) for x, y in zip(inside, outside, strict=True))
        return quats, places, spins, velocities

    def stacked(self, models: Sequence[MotionModel]) -> Callable[[float], se3.Pose]:
        starts = np.cumsum([0, *(len(_knots(model)) for model in models)])
        every: np.ndarray = np.concatenate([_knots(model) for model in models])
        times = [_knots(model)[:, TIME] for model in models]

        def poses(tau: float) -> se3.Pose:
            rows: np.ndarray = starts[:-1] + [int(np.searchsorted(own, tau, side="right")) - 1 for own in times]
            within = rows + 1 < starts[1:]
            at = np.full(len(rows), tau)
            inside = between(every[rows], every[np.where(within, rows + 1, rows)], at)
            outside = _beyond(every[rows], at, np.ones((len(rows), 1), bool))
            quats, places = (np.where(within[:, None], x, y) for x, y in zip(inside[:2], outside[:2], strict=True))
            return quats, places

        return poses

    def kinks(self, model: MotionModel, end: float) -> np.ndarray:
        """Knots: the acceleration jumps at each of them."""
        times = _knots(model)[1:, TIME]
        return times[times <= end]

    def moves(self, model: MotionModel) -> bool:
        knots = _knots(model)
        return bool(any(knots[:, part].any() for part in (PLACE, *VELOCITY)) or self.spins(model))

    def spins(self, model: MotionModel) -> bool:
        knots = _knots(model)
        return bool(knots[:, QUAT][:, 1:].any() or any(knots[:, part].any() for part in SPIN))


def _knots(model: MotionModel) -> np.ndarray:
    assert model.knots is not None
    return model.knots


def between(start: np.ndarray, stop: np.ndarray, tau: np.ndarray) -> Curve:
    """Poses and rates between two knots [..., 20]; of no use for two equal ones."""
    h = (stop[..., TIME] - start[..., TIME])[..., None]
    h = np.where(h > 0, h, 1.0)
    u = (tau - start[..., TIME])[..., None] / h
    ends = start[..., PLACE], stop[..., PLACE]
    d, velocity = _cubic(*ends, start[..., VELOCITY[1]], stop[..., VELOCITY[0]], h, u)
    turn = rotations.multiply(stop[..., QUAT], rotations.conjugate(start[..., QUAT]))
    whole = rotations.quats_to_rotvecs(turn)
    arrival = _rotvec_rate(whole, stop[..., SPIN[0]])
    r, rate = _cubic(np.zeros_like(whole), whole, start[..., SPIN[1]], arrival, h, u)
    quats = rotations.multiply(rotations.rotvecs_to_quats(r), start[..., QUAT])
    return quats, d, se3.v_matrix_times(r, rate), velocity


def _beyond(knot: np.ndarray, tau: np.ndarray, after: np.ndarray) -> Curve:
    """Poses and rates with the constant rates after a knot [..., 20], or before it where ``after`` is False."""
    since = (tau - knot[..., TIME])[..., None]
    velocity, spin = (np.where(after, knot[..., part[1]], knot[..., part[0]]) for part in (VELOCITY, SPIN))
    quats = rotations.multiply(rotations.rotvecs_to_quats(spin * since), knot[..., QUAT])
    return quats, knot[..., PLACE] + velocity * since, spin, velocity


def _cubic(
    a: np.ndarray, b: np.ndarray, leave: np.ndarray, arrive: np.ndarray, h: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Value and slope of the cubic of given ends and slopes, at the fraction u of the time h."""
    slope = 6 * (u - u * u) * (b - a) / h + (1 - 4 * u + 3 * u * u) * leave + (3 * u * u - 2 * u) * arrive
    return cubic_curves.hermite(a, b, leave, arrive, h, u), slope


def _rotvec_rate(r: np.ndarray, w: np.ndarray) -> np.ndarray:
    """V(r)^-1 w: rate of a rotation vector, of at most half a turn, under an angular velocity. [..., 3]"""
    angle2 = (r * r).sum(-1)[..., None]
    half = 0.5 * np.sqrt(np.maximum(angle2, 1e-8))
    factor = np.where(angle2 > 1e-8, (1 - half / np.tan(half)) / np.maximum(angle2, 1e-8), 1 / 12)
    return w - 0.5 * rotations.cross(r, w) + factor * rotations.cross(r, rotations.cross(r, w))


KIND = Trajectory()
