"""Stability cases on extremes: distant origins, fast, reversing, tiny and huge rates, long horizons."""

from __future__ import annotations

import functools
import math

import numpy as np

from ..motion import models, point_dynamics, rotations, se3
from .cases import (
    POINT_ERROR,
    RADIUS,
    ROUNDING,
    Case,
    Twist,
    body,
    exact_exp,
    largest,
    model_error,
    model_of,
    moved,
    rk2_error,
    rk2_points,
    shape_error,
    true_points,
    world_twist,
)

_MODEL_TOLERANCE = 2e-9  # radii
FAST_V, FAST_W = np.array([0.4, -0.2, 0.1]), 1000 * np.array([0.36, 0.48, -0.8])  # per unit of time
_MODEL_SOURCE = "twice the step tolerance of models.evaluate"


_FAR = Twist.of([0.9, -1.4, 1.1], [0.2, 0.1, -0.1], [0.2, 0.3, -0.4], [0.1, 0, 0.05])
_DIAGONAL = np.array([0.6, -0.48, 0.64])


def _far_error(distance: float) -> float:
    """Error of a body of radius 1 whose twist about a distant world origin is recentred first."""
    center = distance * _DIAGONAL
    world = _FAR.about(center)
    v, a = se3.recentre(world.w, world.v, world.eps, world.a, center)
    pose = se3.integrate(world.w, v, world.eps, a, np.float64(1.0), 512)
    return largest(moved(pose, body(1.0)) - true_points(_FAR, 1.0, body(1.0)))


def _rk2_far(distance: float) -> float:
    """Change of shape under TRACE's computation: float32, about the world's origin."""
    center = distance * _DIAGONAL
    points = (body(1.0) + center).astype(np.float32)
    return shape_error(rk2_points(_FAR.about(center), 1.0, points, 60), body(1.0))


def _long_exp(radians: float) -> float:
    """Error of one exponential over many turns against decimal arithmetic, in radii."""
    w, v = radians * np.array([0.36, 0.48, -0.8]), np.array([0.4, -0.2, 0.1])
    rotmat, displacement = exact_exp(w, v)
    return largest(moved(se3.exp(w, v), body()) - body() @ rotmat.T - displacement) / RADIUS


def _one_for_many(radians: float) -> float:
    """Difference between one exponential and the product of 4096 shorter ones, in radii."""
    w, v = radians * np.array([0.36, 0.48, -0.8]), np.array([0.4, -0.2, 0.1])
    many = se3.product(*(np.tile(part, (4096, 1)) for part in se3.exp(w / 4096, v / 4096)))
    return largest(moved(se3.exp(w, v), body()) - moved(many, body())) / RADIUS


def _tiny_exp() -> float:
    """Error of R and d of exponentials against decimal arithmetic, from no rotation to 2 pi."""
    worst = 0.0
    for size in (0.0, 1e-300, 1e-160, 1e-30, 1e-12, 1e-8, 1e-4, 0.5, math.pi - 1e-9, math.pi, 2 * math.pi):
        w, v = size * np.array([0.36, 0.48, -0.8]), np.array([1.0, -2.0, 0.5])
        quat, displacement = se3.exp(w, v)
        rotmat, move = exact_exp(w, v)
        worst = max(worst, np.abs(rotations.quats_to_rotmats(quat) - rotmat).max(), np.abs(displacement - move).max())
    return float(worst)


def _reversing(axis: tuple[float, float, float]) -> tuple[Twist, float]:
    """Spin about z with an opposing rate: it reverses half-way if the axis is z, else the axis tilts over."""
    return Twist.of([0, 0, 4.0], [0.2, 0, 0.1], -4.0 * np.array(axis), [0, 0, 0]), 2.0


def _reversing_model(axis: tuple[float, float, float]) -> float:
    twist, duration = _reversing(axis)
    return model_error(world_twist(twist), twist, duration)


def _reversing_step() -> float:
    twist, duration = _reversing((0, 0, 1))
    pure = Twist(twist.w, np.zeros(3), twist.eps, twist.a)  # a velocity would not commute with the spin's rate
    pose = se3.integrate(pure.w, pure.v, pure.eps, pure.a, np.float64(duration), 1)
    return largest(moved(pose, body()) - true_points(pure, duration, body())) / RADIUS


def _reversing_spin() -> float:
    """Error of the closed form of a spin about the centroid while it reverses, in radii."""
    model = model_of("ballistic_spin", angular_velocity=[0, 0, 4.0], angular_acceleration=[0, 0, -4.0])
    twist, _ = _reversing((0, 0, 1))
    return max(model_error(model, Twist(twist.w, np.zeros(3), twist.eps, twist.a), tau) for tau in (0.5, 1, 1.5, 2))


def _rk2_reversing(axis: tuple[float, float, float]) -> float:
    twist, duration = _reversing(axis)
    return rk2_error(twist, duration, 120)


def _fast_screw() -> float:
    """Error of a constant twist of 1000 rad per unit over one unit, in radii."""
    model = model_of("constant_twist", velocity=FAST_V, angular_velocity=FAST_W)
    rotmat, displacement = exact_exp(FAST_W, FAST_V)
    return largest(moved(models.evaluate(model, 1.0), body()) - body() @ rotmat.T - displacement) / RADIUS


def _fast_world_twist() -> float:
    """Error of a spin of 1000 rad per unit with a tilting axis, over a quarter of a unit, in radii."""
    twist = Twist.of(FAST_W, FAST_V, [200, -100, 300], [0.1, 0, 0])
    return model_error(world_twist(twist), twist, 0.25)


def _huge_rates() -> float:
    """Number of non-finite values in poses under rates of 1e30, for closed forms and steps."""
    vectors = {"velocity": [1e30, 0, -1e30], "acceleration": [0, 1e30, 0]}
    spins = {"angular_velocity": [1e30, 1e29, 0], "angular_acceleration": [0, 0, 1e30]}
    with np.errstate(all="ignore"):
        poses = [models.evaluate(model_of(kind, **vectors, **spins), 1.0) for kind in models.KINDS]
        poses.append(point_dynamics.propagate(np.full((2, 12), 1e30, np.float32), 1.0, 1e-6))
    return float(sum((~np.isfinite(part)).sum() for pose in poses for part in pose))


def _stiff_fade() -> float:
    """Relative distance of offsets blended in over 1e-300 to 1e300 units of time from their limits."""
    offset, worst = np.array([0.1, -0.2, 0.05]), 0.0
    for fade, share in ((1e-300, 1.0), (1e-12, 1.0), (1e-3, 1.0), (1e12, 0.0), (1e300, 0.0)):
        model = model_of("translation", offset_displacement=offset, fade_time=fade)
        _, displacement, _, velocity = models.evaluate_with_rates(model, 0.5)
        gap = np.abs(displacement - share * offset).max() / np.abs(offset).max()
        worst = max(worst, float(gap), float(np.abs(velocity).max()))
    return worst


def _slow_swing() -> float:
    """Relative error of very slow swings against uniform acceleration, and of a fast one against its sine."""
    vectors = {"velocity": [0.3, 0.1, -0.9], "acceleration": [0, 0.4, 6.0]}
    steady = models.evaluate(model_of("translation", **vectors), 2.0)[1]
    slow = [models.evaluate(model_of("translation", **vectors, frequency=f), 2.0)[1] for f in (1e-300, 1e-9)]
    fast = models.evaluate(model_of("translation", velocity=[1, 0, 0], frequency=1e6), 2.0)[1]
    gaps = [np.abs(d - steady).max() / np.abs(steady).max() for d in slow]
    return float(max(*gaps, abs(fast[0] - math.sin(2e6) / 1e6)))


_SLOW = Twist.of([0.3, -0.2, 0.4], [0.1, 0.2, 0.0], [0.004, 0.01, -0.008], [0, 0.01, 0])
_HORIZON = 75.0


def _horizon() -> float:
    """Error of a spin with a tilting axis over 100 times an observed time of 0.75, in radii."""
    return model_error(world_twist(_SLOW), _SLOW, _HORIZON)


_TILTED = (math.sin(0.5), 0.0, math.cos(0.5))

CASES: tuple[Case, ...] = (
    *(
        Case(
            "far from the origin",
            f"twist about a world origin {label} away, radius 1",
            "motion.se3.recentre, motion.se3.integrate",
            "error of a point / radius",
            tolerance,
            "float64 of the given velocity",
            functools.partial(_far_error, d),
            functools.partial(_rk2_far, d),
        )
        for label, d, tolerance in (("1", 1.0, 1e-12), ("100", 1e2, 1e-12), ("1e4", 1e4, 1e-11), ("1e6", 1e6, 1e-9))
    ),
    *(
        Case(
            "fast",
            f"one exponential over {label} rad",
            "motion.se3.exp",
            POINT_ERROR,
            tolerance,
            "float64 of the angle",
            functools.partial(_long_exp, x),
            functools.partial(rk2_error, Twist.of(x * np.array([0.36, 0.48, -0.8]), [0.4, -0.2, 0.1]), 1.0, 60),
        )
        for label, x, tolerance in (
            ("pi", math.pi, 1e-14),
            ("2 pi", 2 * math.pi, 1e-14),
            ("100", 100.0, 1e-13),
            ("1000", 1000.0, 1e-12),
        )
    ),
    *(
        Case(
            "fast",
            f"one exponential is 4096 shorter ones, {label} rad",
            "motion.se3.exp, motion.se3.product",
            POINT_ERROR,
            1e-12,
            ROUNDING,
            functools.partial(_one_for_many, x),
        )
        for label, x in (("2 pi", 2 * math.pi), ("100", 100.0), ("1000", 1000.0))
    ),
    Case(
        "fast",
        "1000 rad per unit, constant twist",
        "motion.models.evaluate",
        POINT_ERROR,
        1e-12,
        "float64 of the angle",
        _fast_screw,
        lambda: rk2_error(Twist.of([360, 480, -800], [0.4, -0.2, 0.1]), 1.0, 60),
    ),
    Case(
        "fast",
        "1000 rad per unit, axis that tilts, 15 steps' time",
        "motion.models.evaluate",
        POINT_ERROR,
        _MODEL_TOLERANCE,
        _MODEL_SOURCE,
        _fast_world_twist,
        lambda: rk2_error(Twist.of([360, 480, -800], [0.4, -0.2, 0.1], [200, -100, 300], [0.1, 0, 0]), 0.25, 15),
    ),
    Case(
        "reversing spin",
        "on its axis, one step",
        "motion.se3.integrate",
        POINT_ERROR,
        1e-12,
        ROUNDING,
        _reversing_step,
        lambda: _rk2_reversing((0, 0, 1)),
    ),
    Case(
        "reversing spin",
        "on its axis, closed form through the stop",
        "motion.models.evaluate",
        POINT_ERROR,
        1e-12,
        ROUNDING,
        _reversing_spin,
        lambda: _rk2_reversing((0, 0, 1)),
    ),
    Case(
        "reversing spin",
        "rate tilted by half a radian",
        "motion.models.evaluate",
        POINT_ERROR,
        _MODEL_TOLERANCE,
        _MODEL_SOURCE,
        lambda: _reversing_model(_TILTED),
        lambda: _rk2_reversing(_TILTED),
    ),
    Case(
        "reversing spin",
        "rate at a right angle",
        "motion.models.evaluate",
        POINT_ERROR,
        _MODEL_TOLERANCE,
        _MODEL_SOURCE,
        lambda: _reversing_model((1, 0, 0)),
        lambda: _rk2_reversing((1, 0, 0)),
    ),
    Case(
        "tiny rates", "spins of 0, 1e-300 to 2 pi rad", "motion.se3.exp", "error of R and d", 1e-14, ROUNDING, _tiny_exp
    ),
    Case(
        "huge rates",
        "velocities, spins and their rates of 1e30",
        "motion.models.evaluate, motion.point_dynamics.propagate",
        "numbers that are not finite",
        0.0,
        "all finite",
        _huge_rates,
    ),
    Case(
        "stiff",
        "offset blended in over 1e-300 to 1e300 units",
        "motion.models.evaluate_with_rates",
        "distance from the limit / offset",
        1e-11,
        "half a unit over 1e12",
        _stiff_fade,
    ),
    Case(
        "stiff",
        "swing of 1e-300, 1e-9 and 1e6 rad per unit",
        "motion.models.evaluate",
        "relative distance from limit and sine",
        1e-12,
        ROUNDING,
        _slow_swing,
    ),
    Case(
        "horizon",
        "100 times the observed time, axis that tilts",
        "motion.models.evaluate",
        POINT_ERROR,
        _MODEL_TOLERANCE,
        _MODEL_SOURCE,
        _horizon,
        lambda: rk2_error(_SLOW, _HORIZON, 4500),
    ),
)
