"""Stability cases on the order of integrators, their step rule, and closed forms."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np

from ..motion import rotations, se3
from .cases import (
    POINT_ERROR,
    RADIUS,
    ROUNDING,
    TILTING,
    TILTING_TIME,
    Case,
    Twist,
    angle,
    body,
    largest,
    moved,
    rk2_error,
    true_points,
)


def magnus_error(twist: Twist, duration: float, steps: int, order: int = 4) -> float:
    """Largest error of a point after Magnus steps, in radii."""
    pose = se3.integrate(twist.w, twist.v, twist.eps, twist.a, np.float64(duration), steps, order)
    points = body()
    return largest(moved(pose, points) - true_points(twist, duration, points)) / RADIUS


def _order_gap(order: int) -> float:
    coarse, fine = (magnus_error(TILTING, TILTING_TIME, steps, order) for steps in (16, 64))
    return abs(math.log2(coarse / fine) / 2 - order)


def _rk2_order() -> float:
    return math.log2(rk2_error(TILTING, TILTING_TIME, 64) / rk2_error(TILTING, TILTING_TIME, 256)) / 2


def _step_rule() -> float:
    """Worst ratio of the real error to the tolerance over random twists, horizons and tolerances."""
    rng, worst = np.random.default_rng(0), 0.0
    for _ in range(60):
        w = rng.normal(size=3)
        w *= 10 ** rng.uniform(-1, 1.5) / np.linalg.norm(w)
        duration, tolerance = rng.uniform(0.2, 2.0), RADIUS * 10 ** rng.uniform(-8, -2)
        eps = rng.normal(size=3)
        eps *= rng.uniform(0, 3) * np.linalg.norm(w) / duration / np.linalg.norm(eps)
        twist = Twist(w, rng.normal(size=3), eps, rng.normal(size=3))
        steps = int(se3.steps_needed(w, twist.v, eps, twist.a, np.float64(duration), RADIUS, tolerance))
        worst = max(worst, magnus_error(twist, duration, steps) * RADIUS / tolerance)
    return worst


def _one_step(twist: Twist, duration: float) -> float:
    return magnus_error(twist, duration, 1)


def _accelerated_spin() -> float:
    twist = Twist.of([1, -2, 0.5], [0.4, 0.1, 0.2], a=[0.3, -0.2, 0.5])
    pose = se3.accelerated_spin(twist.w, twist.v, twist.a, np.float64(2.0))
    return largest(moved(pose, body()) - true_points(twist, 2.0, body())) / RADIUS


def _recentre_rates() -> float:
    """Velocity and acceleration of the centroid from a world twist, against differences of its path."""
    center, step = np.array([0.7, -0.4, 1.1]), 1e-4
    world = TILTING
    v, a = se3.recentre(world.w, world.v, world.eps, world.a, center)
    a_center = a + np.cross(world.w, v)  # of the point that moves, not of the fixed origin
    ahead, here, back = (true_points(world, s, center[None])[0] for s in (step, 0.0, -step))
    velocity, acceleration = (ahead - back) / (2 * step), (ahead - 2 * here + back) / step**2
    return max(float(np.linalg.norm(v - velocity)), float(np.linalg.norm(a_center - acceleration)))


def _scan() -> float:
    """Log-depth products against a loop, for all prefixes of 1, 2, 3, 7, 64 and 1000 steps."""
    rng, worst = np.random.default_rng(3), 0.0
    for count in (1, 2, 3, 7, 64, 1000):
        steps = se3.exp(rng.normal(size=(count, 3)), rng.normal(size=(count, 3)) / count)
        prefixes, total = se3.scan(*steps), se3.product(*steps)
        pose = (rotations.identity(), np.zeros(3))
        for i in range(count):
            pose = se3.compose((steps[0][i], steps[1][i]), pose)
            worst = max(worst, angle(prefixes[0][i], pose[0]), float(np.abs(prefixes[1][i] - pose[1]).max()))
        worst = max(worst, angle(total[0], pose[0]), float(np.abs(total[1] - pose[1]).max()))
    return worst


def _by_steps(name: str, steps: int, order: int, tolerance: float, source: str) -> Case:
    error = functools.partial(magnus_error, TILTING, TILTING_TIME, steps, order)
    other = functools.partial(rk2_error, TILTING, TILTING_TIME, steps)
    return Case("order", name, f"motion.se3.integrate (order {order})", POINT_ERROR, tolerance, source, error, other)


def _closed(name: str, method: str, measure: Callable[[], float]) -> Case:
    return Case("closed forms", name, method, POINT_ERROR, 1e-12, ROUNDING, measure)


_SLIDING = Twist.of((0, 0, 0), [0.4, 0.1, -0.3], a=[0.1, -0.2, 0.05])
_STEADY = Twist.of([1.2, -2.0, 1.9], [0.4, 0.1, -0.3])
_PARALLEL = Twist.of([1.2, -2.0, 1.9], eps=[-1.8, 3.0, -2.85])

CASES: tuple[Case, ...] = (
    Case(
        "order",
        "Magnus-2 is of order 2",
        "motion.se3.integrate (order 2)",
        "|order - 2|",
        0.1,
        "16 to 64 steps",
        lambda: _order_gap(2),
    ),
    Case(
        "order",
        "Magnus-4 is of order 4",
        "motion.se3.integrate (order 4)",
        "|order - 4|",
        0.1,
        "16 to 64 steps",
        lambda: _order_gap(4),
        lambda: abs(_rk2_order() - 4),
    ),
    Case(
        "order",
        "TRACE's integrator is of order 2",
        "motion.point_dynamics.rk2",
        "|order - 2|",
        0.1,
        "64 to 256 steps",
        lambda: abs(_rk2_order() - 2),
    ),
    _by_steps("16 steps, axis that tilts", 16, 4, 1e-4, "leading omitted term"),
    _by_steps("64 steps, axis that tilts", 64, 4, 4e-7, "leading omitted term"),
    _by_steps("256 steps, axis that tilts", 256, 4, 1.6e-9, "leading omitted term"),
    Case(
        "order",
        "steps chosen by rule, 60 random twists",
        "motion.se3.steps_needed",
        "error / requested tolerance",
        2.0,
        "leading omitted term, with a factor of 2",
        _step_rule,
    ),
    Case(
        "order",
        "products in log depth equal a loop, 1 to 1000 steps",
        "motion.se3.scan, motion.se3.product",
        "angle (rad) and distance",
        1e-12,
        ROUNDING,
        _scan,
    ),
    _closed("no spin: one step is exact", "motion.se3.integrate", lambda: magnus_error(_SLIDING, 2.0, 1)),
    _closed("constant twist: one step is exact", "motion.se3.integrate", lambda: magnus_error(_STEADY, 2.0, 1)),
    _closed(
        "spin that slows on its axis: one step is exact",
        "motion.se3.integrate",
        lambda: magnus_error(_PARALLEL, 2.0, 1),
    ),
    _closed("constant spin, accelerating", "motion.se3.accelerated_spin", _accelerated_spin),
    Case(
        "closed forms",
        "world twist to velocity and acceleration of a centre",
        "motion.se3.recentre",
        "distance from differences of the path",
        1e-5,
        "rounding of second differences",
        _recentre_rates,
    ),
)
