"""Type of a stability case, and shared bodies, twists and reference solutions independent of our code.

Notation: a twist (w, v) with rates (eps, a) moves the point x with velocity v + a t + (w + eps t) x x.
"""

from __future__ import annotations

import contextlib
import decimal
import logging
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import numpy as np

from ..motion import knots, models, point_dynamics, rotations

MAX_SECONDS = 10.0  # of processor time, for a case to pass
RADIUS = 0.3
POINT_ERROR = "error of a point / radius"
ROUNDING = "rounding of float64"
_SERIES = 20  # terms of the reference; half a radian a step makes the last one 1e-24


@dataclass(frozen=True)
class Case:
    """Row of the table before it is measured.

    Attributes:
        topic: Topic, by which rows are grouped.
        name: Description of the case.
        method: Tested functions, relative to the package, separated by commas; a remark may follow in parentheses.
        quantity: Measured quantity; less is better.
        tolerance: Maximum measured value that passes.
        source: Origin of the tolerance.
        measure: Runs our code and returns the measured value. An exception is a failure.
        trace_rk2: Returns the same value for TRACE's integrator on each point (`point_dynamics.rk2`), or None if it
            does not apply. For information only; it never fails a case.
        prepare: Untimed preparation, such as compilation.
    """

    topic: str
    name: str
    method: str
    quantity: str
    tolerance: float
    source: str
    measure: Callable[[], float]
    trace_rk2: Callable[[], float] | None = None
    prepare: Callable[[], object] | None = None


@dataclass(frozen=True)
class Twist:
    """Twist that is linear in time, about the origin. [3] each"""

    w: np.ndarray
    v: np.ndarray
    eps: np.ndarray
    a: np.ndarray

    @staticmethod
    def of(w: object, v: object = (0, 0, 0), eps: object = (0, 0, 0), a: object = (0, 0, 0)) -> Twist:
        """Construct a twist from array-like values."""
        return Twist(*(np.array(x, np.float64) for x in (w, v, eps, a)))

    def about(self, center: np.ndarray) -> Twist:
        """Return the twist of the same motion about another origin, in which the old origin lies at ``center``."""
        away = -np.asarray(center, np.float64)
        return Twist(self.w, self.v + np.cross(self.w, away), self.eps, self.a + np.cross(self.eps, away))


# Spin of 3 rad per unit about a tilting axis, with a translation: none of these rotations and translations commute.
TILTING = Twist.of([1.2, -2.0, 1.9], [0.4, 0.1, -0.3], [0.5, 0.4, -0.39], [0.1, -0.2, 0.05])
TILTING_TIME = 2.0


@contextlib.contextmanager
def logged() -> Iterator[list[str]]:
    """Yield the list of messages that the core logs in the block; they are not propagated to other handlers."""
    logger, messages = logging.getLogger(__name__.rpartition(".stability.")[0]), []
    handler = logging.Handler()
    handler.emit = lambda record: messages.append(record.getMessage())
    passes_on, logger.propagate = logger.propagate, False
    logger.addHandler(handler)
    try:
        yield messages
    finally:
        logger.removeHandler(handler)
        logger.propagate = passes_on


def body(radius: float = RADIUS) -> np.ndarray:
    """Points in 26 directions at one distance from the origin. [26, 3]"""
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), -1).reshape(-1, 3)
    grid = grid[np.abs(grid).sum(-1) > 0]
    return radius * grid / np.linalg.norm(grid, axis=-1, keepdims=True)


def moved(pose: tuple[np.ndarray, np.ndarray], points: np.ndarray) -> np.ndarray:
    """Move points of a body by a pose: unit quaternion [4] and displacement [3]. [n, 3]"""
    return rotations.rotate(pose[0], points) + pose[1]


def largest(difference: np.ndarray) -> float:
    """Return the largest norm of a row; NaN if an entry is NaN. [n, 3]"""
    return float(np.sqrt((np.asarray(difference, np.float64) ** 2).sum(-1)).max())


def angle(p: np.ndarray, q: np.ndarray) -> float:
    """Return the largest angle between unit quaternions, rad; computed from differences to resolve small angles."""
    p, q = np.asarray(p, np.float64), np.asarray(q, np.float64)
    gap = np.minimum(np.linalg.norm(p - q, axis=-1), np.linalg.norm(p + q, axis=-1))
    return float(4 * np.arcsin(np.minimum(gap / 2, 1)).max())


def different(first: object, second: object) -> float:
    """Return the number of values that differ, ignoring the sign of zero; NaN equals NaN."""
    x, y = np.asarray(first), np.asarray(second)
    if x.shape != y.shape:
        return math.inf
    return float(((x != y) & ~(np.isnan(x) & np.isnan(y))).sum())


def truth(twist: Twist, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation matrix [3, 3] and displacement [3] after a signed time, exact to rounding.

    Taylor series of the matrix equation T' = X(t) T in steps of at most half a radian; independent of exponentials,
    brackets and quaternions.
    """
    turn = (np.linalg.norm(twist.w) + np.linalg.norm(twist.eps) * abs(duration)) * abs(duration)
    steps = max(1, math.ceil(2 * turn))
    h = duration / steps
    rate = _matrix(twist.eps, twist.a)
    start = _matrix(twist.w, twist.v) + (h * np.arange(steps))[:, None, None] * rate
    before, term = np.zeros((steps, 4, 4)), np.tile(np.eye(4), (steps, 1, 1))
    total = term.copy()
    for k in range(_SERIES):
        before, term = term, (h * start @ term + h * h * rate @ before) / (k + 1)
        total = total + term
    while len(total) > 1:
        even = len(total) // 2 * 2
        total = np.concatenate([total[1:even:2] @ total[:even:2], total[even:]])
    return total[0, :3, :3], total[0, :3, 3]


def true_points(twist: Twist, duration: float, points: np.ndarray) -> np.ndarray:
    """Move points by `truth`. [n, 3]"""
    rotmat, displacement = truth(twist, duration)
    return points @ rotmat.T + displacement


def model_error(model: models.MotionModel, twist: Twist, tau: float) -> float:
    """Return the largest difference of a point between a motion model and a twist about its pivot, in radii."""
    points = body()
    return largest(moved(models.evaluate(model, tau), points) - true_points(twist, tau, points)) / RADIUS


def world_twist(twist: Twist) -> models.MotionModel:
    """Return the motion model of a twist about the pivot."""
    rates = {"velocity": twist.v, "acceleration": twist.a, "angular_velocity": twist.w}
    return model_of("world_twist", **rates, angular_acceleration=twist.eps)


def model_of(kind: str, **rates: Any) -> models.MotionModel:
    """Return a motion model of any kind; a top gets three different moments of inertia, a trajectory two knots."""
    needs = models.KINDS[kind]
    inertia = np.diag([0.4, 0.8, 1.0]) if needs.needs_inertia else None
    path = _path(rates) if needs.needs_knots else None
    return models.MotionModel(kind, radius=RADIUS, inertia=inertia, knots=path, **rates)


def _path(rates: Mapping[str, Any]) -> np.ndarray:
    """Return the knots of a body with constant rates, of which one is after a unit of time."""
    velocities, spins = (
        np.tile(np.asarray(rates.get(name, np.zeros(3)), float), (2, 1)) for name in ("velocity", "angular_velocity")
    )
    times = np.array([0.0, 1.0])
    poses = rotations.rotvecs_to_quats(times[:, None] * spins), times[:, None] * velocities
    return knots.pack(times, poses, (velocities, velocities), (spins, spins))


def rk2_points(twist: Twist, duration: float, points: np.ndarray, steps: int) -> np.ndarray:
    """Move points by TRACE's integrator, in the precision of ``points``. [n, 3]"""
    v, w, a, e = (np.asarray(x, points.dtype) for x in (twist.v, twist.w, twist.a, twist.eps))
    with np.errstate(all="ignore"):
        return point_dynamics.rk2(points, v, w, a, e, duration, abs(duration) / steps)[0]


def rk2_error(twist: Twist, duration: float, steps: int, radius: float = RADIUS) -> float:
    """Largest error of a point under TRACE's integrator, in radii."""
    points = body(radius)
    return largest(rk2_points(twist, duration, points, steps) - true_points(twist, duration, points)) / radius


def shape_error(points: np.ndarray, bind: np.ndarray) -> float:
    """Largest relative change of a distance between two points. [n, 3] each"""
    before, after = _distances(bind), _distances(points)
    return float(np.abs(after / before - 1).max())


def ratios(angle2: float | Decimal) -> tuple[Decimal, Decimal, Decimal]:
    """sin(x)/x, (1 - cos x)/x^2 and (x - sin x)/x^3 for x^2 given, from their series in decimal arithmetic."""
    x2 = Decimal(angle2)
    with decimal.localcontext() as context:
        context.prec = _digits(float(x2))
        sums = [Decimal(0)] * 3
        term, k = Decimal(1), 0
        while k < 4 or abs(term) > Decimal(10) ** -50:
            sums[0] += term / (2 * k + 1)
            sums[1] += term / ((2 * k + 1) * (2 * k + 2))
            sums[2] += term / ((2 * k + 1) * (2 * k + 2) * (2 * k + 3))
            k += 1
            term = -term * x2 / ((2 * k - 1) * (2 * k))
        return sums[0], sums[1], sums[2]


def exact_exp(w: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation matrix and displacement of the exponential of a twist, in decimal arithmetic, then rounded. [3], [3]"""
    turn, move = [Decimal(float(x)) for x in w], [Decimal(float(x)) for x in v]
    with decimal.localcontext() as context:
        context.prec = _digits(float(w @ w))
        # In decimals: the digits of x^2 that float64 does not hold matter after many turns.
        a, b, c = ratios(sum((x * x for x in turn), Decimal(0)))
        columns = []
        for axis in range(3):
            unit = [Decimal(int(axis == i)) for i in range(3)]
            once = _cross(turn, unit)
            twice = _cross(turn, once)
            columns.append([float(u + a * x + b * y) for u, x, y in zip(unit, once, twice, strict=True)])
        once = _cross(turn, move)
        twice = _cross(turn, once)
        moved_by = [float(m + b * x + c * y) for m, x, y in zip(move, once, twice, strict=True)]
    return np.array(columns).T, np.array(moved_by)


def _digits(angle2: float) -> int:
    """Number of decimal digits that keeps 50 significant ones, as the terms of the series grow to exp(x) at first."""
    return 60 + math.ceil(math.sqrt(angle2) / math.log(10))


def _cross(x: list[Decimal], y: list[Decimal]) -> list[Decimal]:
    return [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]]


def _matrix(w: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The 4 x 4 matrix of a twist."""
    return np.array([[0, -w[2], w[1], v[0]], [w[2], 0, -w[0], v[1]], [-w[1], w[0], 0, v[2]], [0, 0, 0, 0]])


def _distances(points: np.ndarray) -> np.ndarray:
    """Distances of all pairs. [n, 3] -> [n (n - 1) / 2]"""
    i, j = np.triu_indices(len(points), 1)
    return np.linalg.norm(points.astype(np.float64)[i] - points.astype(np.float64)[j], axis=-1)
