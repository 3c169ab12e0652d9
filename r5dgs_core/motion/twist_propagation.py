"""Propagation of many points, each with its own twist, with time-independent quantities precomputed.

Notation: x = (w, v) the twist of a point about its own centre at time 0, b = (e, a) its rate, T the duration. For a
twist that is linear in time the bracket C = [x, b] is constant, so a Magnus step of length h with midpoint m is
exp(h x + h m b - h^3/12 C), which takes three products. Arrays are stored by column, [6, n] (`quaternion_columns`).
The ratios B = 2 sin(|u|/2)^2/|u|^2, C and D of `se3` lose precision near u = 0, but the factors that multiply them
vanish equally fast, so no series is needed.
"""

from __future__ import annotations

import functools
import logging
import math

import numpy as np

from . import quaternion_columns, rotations, se3

log = logging.getLogger(__name__)

MAX_STEPS = 512  # steps per frame of thousands of points, to bound the time
MAX_DIFFICULTY = 1e12  # difficulty above which results may be inaccurate or not finite
CHUNK = 2048  # points per block, sized for the CPU cache
_TINY = 1e-30


class Propagator:
    """Rotations and displacements of points under dynamics about their own centres, at any time.

    Points at rest are skipped, twists without angular acceleration use a closed form, and the others take fourth-order
    Magnus steps in blocks of similar difficulty. Points whose dynamics or poses are not finite stay at rest, with a
    warning. The others stay within the tolerance if ``most_steps`` suffices.

    Args:
        dynamics: Velocity, angular velocity and the rates of both, about the centre of each point. [N, 12]
        tolerance: Maximum error of a point, in the units of its velocity times time, > 0. A number or [N]
        radius: Lever arm that converts rotation errors to position errors. A number or [N]
        most_steps: Maximum number of steps to any time, >= 1; if more are needed, errors exceed the tolerance.
    """

    def __init__(
        self,
        dynamics: np.ndarray,
        tolerance: float | np.ndarray,
        radius: float | np.ndarray = 0.0,
        most_steps: int = MAX_STEPS,
    ):
        state = np.asarray(dynamics)
        self._most_steps = most_steps
        self.count = len(state)
        sound = np.isfinite(state).all(-1)
        moving = np.flatnonzero((state != 0).any(-1) & sound)
        v, w, a, e = np.split(np.ascontiguousarray(state[moving].T, np.float64), 4)
        x, b = np.concatenate([w, v]), np.concatenate([e, a])
        reach = np.broadcast_to(np.asarray(radius, np.float64), (self.count,))[moving]
        limit = np.broadcast_to(np.asarray(tolerance, np.float64), (self.count,))[moving]
        with np.errstate(over="ignore", invalid="ignore"):
            bracket = _bracket(x, b)
            omitted = _omitted(x, b, bracket, reach) / limit
            turning = np.stack([_norms(w), _norms(e)])
            difficulty = omitted.sum(0) + turning.sum(0)
            speed = (reach * turning[0] + _norms(v)) / limit
        commuting = (omitted <= 1e-15 * speed).all(0)
        omitted[:, commuting], turning[:, commuting], difficulty[commuting] = 0.0, 0.0, 0.0
        wild = ~(difficulty < MAX_DIFFICULTY)
        kind = np.where(wild, 2, np.where(~commuting & (e == 0).all(0), 1, 0))
        order = np.lexsort((difficulty, kind))
        edges = np.searchsorted(kind[order], [0, 1, 2, 3])
        self.rows = moving[order]
        self._twists, self._rates, self._brackets = x[:, order], b[:, order], bracket[:, order]
        self._parts = [
            (slice(start, min(start + CHUNK, edges[k + 1])), k)
            for k in range(3)
            for start in range(int(edges[k]), int(edges[k + 1]), CHUNK)
        ]
        self._omitted = [omitted[:, order[part]].max(-1) for part, _ in self._parts]
        self._turning = [turning[:, order[part]].max(-1) for part, _ in self._parts]
        if not sound.all():
            warn_of_wild_dynamics(int((~sound).sum()), self.count)

    def columns(self, duration: float) -> tuple[np.ndarray, np.ndarray]:
        """Motion of the moving points, in the order of `rows`.

        Args:
            duration: Signed duration.

        Returns:
            Unit quaternions wxyz [4, n] and displacements [3, n], float64, by column.
        """
        quats, displacements = np.empty((4, len(self.rows))), np.empty((3, len(self.rows)))
        for i, (part, kind) in enumerate(self._parts):
            x, b, c = self._twists[:, part], self._rates[:, part], self._brackets[:, part]
            if kind == 1:
                quats[:, part], displacements[:, part] = _accelerated_spin(x, b[3:], duration)
                continue
            with np.errstate(over="ignore", invalid="ignore"):
                q, d = _magnus(x, b, c, duration, self._steps(i, duration))
            if kind == 2:
                lost = ~(np.isfinite(q).all(0) & np.isfinite(d).all(0))
                q[:, lost], d[:, lost] = np.array([[1.0], [0], [0], [0]]), 0.0
                if lost.any():
                    warn_of_wild_dynamics(int(lost.sum()), self.count)
            quats[:, part], displacements[:, part] = q, d
        return quats, displacements

    def rows_of(self, duration: float) -> tuple[np.ndarray, np.ndarray]:
        """Unit quaternions wxyz [N, 4] and displacements [N, 3] of all points, float64."""
        quats, displacements = rotations.identity(self.count), np.zeros((self.count, 3))
        if duration != 0 and len(self.rows):
            q, d = self.columns(duration)
            quats[self.rows], displacements[self.rows] = q.T, d.T
        return quats, displacements

    def _steps(self, i: int, duration: float) -> int:
        span = abs(duration)
        omitted, turning = self._omitted[i], self._turning[i]
        error = (omitted[0] + omitted[1] * span + omitted[2] * span**2) * span**5
        by_turn = (turning[0] + turning[1] * span) * span / 2
        if not (error**0.25 < se3.MAX_STEPS and by_turn < se3.MAX_STEPS):  # no number of steps suffices
            return min(MAX_STEPS, self._most_steps)
        return min(max(1, math.ceil(error**0.25), math.ceil(by_turn)), self._most_steps)


@functools.cache
def warn_of_wild_dynamics(bad: int, count: int) -> None:
    log.warning("%d of %d points have dynamics that are not finite and stay at their positions at t_max", bad, count)


def _omitted(x: np.ndarray, b: np.ndarray, bracket: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Leading error terms of Magnus-4 as coefficients of a polynomial in time; bounds of `se3.steps_needed`'s mean.
    [3, n]
    """
    once, other = _bracket(x, bracket), _bracket(b, bracket)
    terms = (
        _bracket(x, once) / 720 - other / 240,
        (_bracket(b, once) + _bracket(x, other)) / 1440,
        _bracket(b, other) / 2160,
    )
    return np.stack([reach * _norms(term[:3]) + _norms(term[3:]) for term in terms])


def _magnus(x: np.ndarray, b: np.ndarray, c: np.ndarray, duration: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses after equal steps, batched to fit the cache. [6, n] each -> [4, n], [3, n]"""
    count, h = x.shape[1], duration / steps
    fixed = (h * x - (h**3 / 12) * c)[:, None]
    quats, displacements = np.empty((4, 0)), np.empty((3, 0))
    at_once = max(1, CHUNK // max(count, 1))
    for start in range(0, steps, at_once):
        middles = (np.arange(start, min(start + at_once, steps)) + 0.5) * h * h
        taken = len(middles)
        q, d = _exp((fixed + middles[:, None] * b[:, None]).reshape(6, taken * count))
        q, d = _product(q.reshape(4, taken, count), d.reshape(3, taken, count))
        if start:
            displacements = quaternion_columns.rotate(q, displacements) + d
            quats = quaternion_columns.multiply(q, quats)
        else:
            quats, displacements = q, d
    if steps > 1:
        quats /= np.sqrt((quats * quats).sum(0))
    return quats, displacements


def _product(quats: np.ndarray, displacements: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compose poses along axis 1 by pairwise reduction. [4, s, n], [3, s, n] -> [4, n], [3, n]"""
    while quats.shape[1] > 1:
        even = quats.shape[1] // 2 * 2
        first, second = slice(0, even, 2), slice(1, even, 2)
        d = quaternion_columns.rotate(quats[:, second], displacements[:, first]) + displacements[:, second]
        q = quaternion_columns.multiply(quats[:, second], quats[:, first])
        quats = np.concatenate([q, quats[:, even:]], axis=1)
        displacements = np.concatenate([d, displacements[:, even:]], axis=1)
    return quats[:, 0], displacements[:, 0]


def _exp(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pose of one unit of time under a constant twist. [6, n] -> [4, n], [3, n]"""
    return _turn(u[:3], u[3:])[:2]


def _turn(w: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """exp(w) and V(w) v, with |w| and sin(|w|/2) for `_accelerated_spin`."""
    angle = np.maximum(_norms(w), _TINY)
    half = 0.5 * angle
    s, cosine = np.sin(half), np.cos(half)
    ratio = s / angle
    quats = np.empty((4, w.shape[1]))
    quats[0] = cosine
    np.multiply(ratio, w, out=quats[1:])
    once = quaternion_columns.cross(w, v)
    displacements = v + (2 * ratio * ratio) * once
    displacements += ((angle - 2 * s * cosine) / (angle * angle * angle)) * quaternion_columns.cross(w, once)
    return quats, displacements, angle, s


def _accelerated_spin(x: np.ndarray, a: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Closed form for twists with constant w, as in `se3.accelerated_spin`. [6, n], [3, n] -> [4, n], [3, n]"""
    w, v = duration * x[:3], duration * x[3:]
    quats, displacements, angle, s = _turn(w, v)
    square = angle * angle
    twice = duration * duration * a
    once = quaternion_columns.cross(w, twice)
    displacements += 0.5 * twice + ((angle - 2 * s * quats[0]) / (square * angle)) * once
    displacements += ((0.5 * square - 2 * s * s) / (square * square)) * quaternion_columns.cross(w, once)
    return quats, displacements


def _bracket(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Lie bracket [(w1, v1), (w2, v2)] = (w1 x w2, w1 x v2 - w2 x v1) by column. [6, n] each"""
    return np.concatenate(
        [
            quaternion_columns.cross(x[:3], y[:3]),
            quaternion_columns.cross(x[:3], y[3:]) - quaternion_columns.cross(y[:3], x[3:]),
        ]
    )


def _norms(columns: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("cn,cn->n", columns, columns))
