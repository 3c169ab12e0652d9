"""TRACE's midpoint integration with random access: full steps are cached."""

from __future__ import annotations

import numpy as np

from . import point_dynamics, rotations

State = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # points, rotations, v, w
MAX_STEPS = 20000  # maximum number of cached steps; motion stops after the last


class MidpointPath:
    """`point_dynamics.rk2` of the same points at many times, with bit-identical results.

    A point whose position is no longer finite stays at its last finite position. All points stop after `MAX_STEPS`.

    Args:
        points: Start positions. [..., 3]
        v: Velocity of the point at the origin. [..., 3]
        w: Angular velocity, rad per unit. [..., 3]
        a: Rate of v. [..., 3]
        e: Rate of w. [..., 3]
        step: Longest step, > 0.
    """

    def __init__(self, points: np.ndarray, v: np.ndarray, w: np.ndarray, a: np.ndarray, e: np.ndarray, step: float):
        self._rates, self._step = (a, e), step
        self._states = [(points, rotations.rotvecs_to_quats(0 * points), v, w)]

    def at(self, duration: float) -> tuple[np.ndarray, np.ndarray]:
        """Points [..., 3] and rotations since the start, unit wxyz [..., 4], at a time >= 0."""
        if duration < 0:
            raise ValueError(f"duration: expected a time >= 0, got {duration}")
        if duration == 0:
            return self._states[0][0], self._states[0][1]
        steps = point_dynamics.step_sizes(min(duration, MAX_STEPS * self._step), self._step)
        while len(self._states) < len(steps):
            self._states.append(self._next(self._states[-1], self._step))
        points, quats, _, _ = self._next(self._states[len(steps) - 1], steps[-1])
        return points, quats

    def _next(self, state: State, h: float) -> State:
        """Points, rotations and twist one step later."""
        (points, quats, v, w), (a, e) = state, self._rates
        half_v, half_w = 0.5 * h * a, 0.5 * h * e
        with np.errstate(over="ignore", invalid="ignore"):
            moved, turn = point_dynamics.rk2(points, v, w, a, e, h, h)
            turned = rotations.multiply(turn, quats)
        lost = ~(np.isfinite(moved).all(-1) & np.isfinite(turned).all(-1))[..., None]
        return np.where(lost, points, moved), np.where(lost, quats, turned), v + half_v + half_v, w + half_w + half_w
