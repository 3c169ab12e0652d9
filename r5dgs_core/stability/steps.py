"""Stability cases on many steps: growth, drift, the time grid, forward and backward time."""

from __future__ import annotations

import functools
import itertools
import math

import numpy as np

from ..motion import models, point_dynamics, rotations, se3
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
    different,
    largest,
    logged,
    model_of,
    moved,
    rk2_points,
    true_points,
    world_twist,
)

_STEP = point_dynamics.TRACE_STEP


def _growth(x: float) -> float:
    """Return the relative growth of a point's arm in one step of x radians."""
    pose = se3.integrate(np.array([0, 0, x]), np.zeros(3), np.zeros(3), np.zeros(3), np.float64(1.0), 1)
    return abs(float(np.linalg.norm(moved(pose, np.array([1.0, 0, 0])))) - 1)


def _rk2_growth(x: float, steps: int = 1) -> float:
    point = rk2_points(Twist.of([0, 0, x * steps]), 1.0, np.array([[1.0, 0, 0]]), steps)
    return abs(float(np.linalg.norm(point)) - 1)


def _rk2_growth_formula() -> float:
    return max(abs(_rk2_growth(x) + 1 - math.sqrt(1 + x**4 / 4)) for x in (0.1, 0.5, 1.0, math.pi, 2 * math.pi))


def _growth_per_unit(w: float) -> float:
    pose = se3.integrate(np.array([0, 0, w]), np.zeros(3), np.zeros(3), np.zeros(3), np.float64(1.0), 60)
    return abs(float(np.linalg.norm(moved(pose, np.array([1.0, 0, 0])))) - 1)


_LONG = 1_000_000
_LONG_SPIN = np.array([1.2, -0.9, 1.445])  # 2.08 rad per unit
_LONG_TWIST = Twist(_LONG_SPIN, np.array([0.3, 0.1, -0.2]), np.zeros(3), np.zeros(3))


def _million() -> tuple[np.ndarray, np.ndarray]:
    """Return the product of a million equal steps, computed in blocks to limit memory."""
    block = 50_000
    step = se3.exp(_STEP * _LONG_TWIST.w, _STEP * _LONG_TWIST.v)
    blocks = [se3.product(*(np.tile(part, (block, 1)) for part in step)) for _ in range(_LONG // block)]
    quats, displacements = zip(*blocks, strict=True)
    return se3.product(np.stack(quats), np.stack(displacements))


def _million_unit() -> float:
    return abs(float(np.linalg.norm(_million()[0])) - 1)


def _million_pose() -> float:
    quat, displacement = _million()
    # One exponential, which has its own cases; the step is the one that float64 has, not 1/60.
    turned, move = se3.exp(_LONG * (_STEP * _LONG_TWIST.w), _LONG * (_STEP * _LONG_TWIST.v))
    return max(angle(rotations.normalize(quat), turned), float(np.linalg.norm(displacement - move)))


def _rk2_million() -> float:
    """Relative growth of an arm, from a matrix power: at constant w, all steps are the same linear map."""
    still = Twist(_LONG_SPIN, np.zeros(3), np.zeros(3), np.zeros(3))
    step = rk2_points(still, _STEP, np.eye(3), 1).T
    return float(np.linalg.norm(np.linalg.matrix_power(step, _LONG), 2)) - 1


def _single_precision_rates() -> float:
    """Error of 10,000 steps in radii, for float32 rates; the integration itself must keep float64 precision."""
    w, v, eps, a = (np.asarray(x, np.float32) for x in (TILTING.w, TILTING.v, TILTING.eps, TILTING.a))
    same = Twist.of(w, v, eps, a)
    pose = se3.integrate(w, v, eps, a, np.float32(TILTING_TIME), 10_000)
    return largest(moved(pose, body()) - true_points(same, TILTING_TIME, body())) / RADIUS


def _orthogonality() -> float:
    """Deviation from orthogonality of a rotation matrix cast to float32 after 10,000 steps."""
    quat, _ = se3.integrate(_LONG_SPIN, np.zeros(3), np.zeros(3), np.zeros(3), np.float64(1e4 / 60), 10_000)
    rotmat = rotations.quats_to_rotmats(quat).astype(np.float32).astype(np.float64)
    return float(np.abs(rotmat.T @ rotmat - np.eye(3)).max())


def _grid(duration: float) -> float:
    """Error of the number of steps plus the relative error of their sum, for a whole number of steps."""
    steps = point_dynamics.step_sizes(duration, _STEP)
    return abs(len(steps) - round(duration / _STEP)) + abs(math.fsum(steps) - duration) / duration


_unused_steps = itertools.count()


def _unguarded() -> float:
    """Return 1 if TRACE's integrator takes steps of 1 rad without a warning, else 0; it warns once per step length."""
    step = 0.1 + 1e-6 * next(_unused_steps)
    with logged() as messages:
        point_dynamics.rk2(np.ones(3), np.zeros(3), np.array([0, 0, 1 / step]), np.zeros(3), np.zeros(3), step, step)
    return float(not messages)


def _back(steps: int) -> float:
    """Largest distance of a point from its start after integration forward and back, in radii."""
    t = np.float64(TILTING_TIME)
    there = se3.integrate(TILTING.w, TILTING.v, TILTING.eps, TILTING.a, t, steps)
    w, v = TILTING.w + t * TILTING.eps, TILTING.v + t * TILTING.a
    home = se3.compose(se3.integrate(w, v, TILTING.eps, TILTING.a, -t, steps), there)
    return largest(moved(home, body()) - body()) / RADIUS


def _rk2_back(steps: int) -> float:
    t = TILTING_TIME
    there = rk2_points(TILTING, t, body(), steps)
    end = Twist(TILTING.w + t * TILTING.eps, TILTING.v + t * TILTING.a, TILTING.eps, TILTING.a)
    return largest(rk2_points(end, -t, there, steps) - body()) / RADIUS


def _before() -> float:
    """Largest error of `curve` before t_max, in radii, for two kinds that equal a twist."""
    spin = model_of("constant_twist", velocity=TILTING.v, angular_velocity=TILTING.w)
    gaps = []
    for model, twist in ((spin, Twist.of(TILTING.w, TILTING.v)), (world_twist(TILTING), TILTING)):
        quat, displacement, _, _ = models.curve(model, -1.5)
        gaps.append(largest(moved((quat, displacement), body()) - true_points(twist, -1.5, body())) / RADIUS)
    return max(gaps)


def _group_property() -> float:
    """Difference between a motion over T1 + T2 and the composition of those over T1 and T2, in radii."""
    whole = models.evaluate(world_twist(TILTING), 2.0)
    w, v = TILTING.w + 1.3 * TILTING.eps, TILTING.v + 1.3 * TILTING.a
    second = models.evaluate(world_twist(Twist(w, v, TILTING.eps, TILTING.a)), 0.7)
    parts = se3.compose(second, models.evaluate(world_twist(TILTING), 1.3))
    return largest(moved(whole, body()) - moved(parts, body())) / RADIUS


def _no_time() -> float:
    """Number of values that differ from the identity after duration 0, in all integrators and motion kinds."""
    zero = np.float64(0.0)
    poses = [se3.integrate(TILTING.w, TILTING.v, TILTING.eps, TILTING.a, zero, n) for n in (1, 3, 64)]
    poses.append(se3.accelerated_spin(TILTING.w, TILTING.v, TILTING.a, zero))
    vectors = {"velocity": [1, 2, 3], "angular_velocity": [3, 2, 1], "offset_rotvec": [0.1, 0, 0.2]}
    many = [model_of(kind, **vectors, offset_displacement=[0.1, 0.2, 0.3]) for kind in models.KINDS]
    poses += [models.evaluate(model, 0.0) for model in many]
    poses += list(zip(*models.evaluate_all(many, 0.0), strict=True))
    state = np.random.default_rng(0).normal(size=(5, 12))
    poses += list(zip(*point_dynamics.propagate(state, 0.0, 1e-6), strict=True))
    return sum(different(q, rotations.identity()) + different(d, np.zeros(3)) for q, d in poses)


_GROWTH = "change of the length of an arm"
_STEPS = "whole steps off, and end / duration - 1"

CASES: tuple[Case, ...] = (
    *(
        Case(
            "growth",
            f"one step of {label} rad",
            "motion.se3.integrate",
            _GROWTH,
            2e-15,
            ROUNDING,
            functools.partial(_growth, x),
            functools.partial(_rk2_growth, x),
        )
        for label, x in (("0.1", 0.1), ("0.5", 0.5), ("1", 1.0), ("pi", math.pi), ("2 pi", 2 * math.pi))
    ),
    *(
        Case(
            "growth",
            f"{w} rad per unit, 60 steps",
            "motion.se3.integrate",
            _GROWTH,
            1e-13,
            ROUNDING,
            functools.partial(_growth_per_unit, w),
            functools.partial(_rk2_growth, w / 60, 60),
        )
        for w in (10, 20, 50, 100)
    ),
    Case(
        "growth",
        "TRACE's integrator grows by sqrt(1 + x^4 / 4) a step",
        "motion.point_dynamics.rk2",
        "distance from the formula",
        1e-9,
        "the formula",
        _rk2_growth_formula,
    ),
    Case(
        "growth",
        "TRACE's integrator warns about steps over 0.1 rad",
        "motion.point_dynamics.rk2",
        "steps without a warning",
        0.0,
        "its growth is visible from there on",
        _unguarded,
    ),
    Case(
        "drift",
        "a million steps: unit quaternion without normalisation",
        "motion.se3.product",
        "| |q| - 1 |",
        1e-10,
        "a million roundings of 1e-16",
        _million_unit,
        _rk2_million,
    ),
    Case(
        "drift",
        "a million steps: the pose",
        "motion.se3.product",
        "angle (rad) and distance",
        1e-8,
        "float64: 1e6 steps of 1e-16, over a path of 6e3",
        _million_pose,
    ),
    Case(
        "drift",
        "float32 rates, 10,000 steps",
        "motion.se3.integrate",
        POINT_ERROR,
        1e-12,
        ROUNDING,
        _single_precision_rates,
    ),
    Case(
        "drift",
        "rotation cast once to float32 after 10,000 steps",
        "motion.se3.integrate",
        "|R'R - I|",
        3e-7,
        "rounding of float32",
        _orthogonality,
    ),
    *(
        Case(
            "time grid",
            f"{units} {'unit' if units == 1 else 'units'} of 60 steps",
            "motion.point_dynamics.step_sizes",
            _STEPS,
            1e-12,
            "whole numbers of steps",
            functools.partial(_grid, float(units)),
        )
        for units in (1, 10, 1000)
    ),
    *(
        Case(
            "direction of time",
            f"forward, then backward, {n} {'step' if n == 1 else 'steps'}",
            "motion.se3.integrate",
            POINT_ERROR,
            1e-13,
            ROUNDING,
            functools.partial(_back, n),
            functools.partial(_rk2_back, n),
        )
        for n in (1, 4, 60)
    ),
    Case(
        "direction of time",
        "before t_max",
        "motion.models.curve",
        POINT_ERROR,
        2e-9,
        "twice the step tolerance of models.evaluate",
        _before,
    ),
    Case(
        "direction of time",
        "T1 followed by T2 equals T1 + T2",
        "motion.models.evaluate, motion.se3.compose",
        POINT_ERROR,
        2e-9,
        "twice the step tolerance of models.evaluate",
        _group_property,
    ),
    Case(
        "direction of time",
        "duration 0 gives the identity, to the bit",
        "motion.se3.integrate, motion.models.evaluate, motion.point_dynamics.propagate",
        "values that differ",
        0.0,
        "to the bit",
        _no_time,
    ),
)
