"""Stability cases on kinds of motion past t_max that are stiff or end, and on breaks in tracks."""

from __future__ import annotations

import functools
import math

import numpy as np

from ..motion import models, rotations
from ..motion_fit import band, model_selection
from .cases import RADIUS, ROUNDING, Case, largest, model_of
from .scenes import DIAGONAL, T_MAX, TIMES

_RATES = {"velocity": [0.5, 0, 1], "acceleration": [0, 0, -6], "angular_velocity": [1, 2, -3]}


def _stiff_drag(damping: float) -> float:
    """Distance from the exact place after one unit: v (1 - exp(-c)) / c + a (1 - (1 - exp(-c)) / c) / c."""
    model = model_of("drag", **_RATES, damping=damping)
    once = -math.expm1(-damping) / damping
    twice = (1 - once) / damping if damping > 1e-3 else 0.5 - damping / 6
    _, d = models.evaluate(model, np.array([1.0]))
    return largest(d - (once * model.velocity + twice * model.acceleration))


def _fast_precession(spin: float) -> float:
    """Distance of the pivot from its place while a body precesses with this spin, in radii."""
    rates = {"angular_velocity": [0, 0, spin], "precession": [0.1 * spin, 0, 0], "center_offset": [1, 0, 0]}
    model = model_of("precession", **rates)
    quats, d = models.evaluate(model, np.linspace(0.0, 3.0, 97))
    u = np.broadcast_to(model.center_offset, d.shape)
    return largest(rotations.rotate(quats, u) + d - u)


def _many_bounces(restitution: float) -> float:
    """Depth below the floor of a ball that bounces for a hundred units of time."""
    model = model_of("bounce", velocity=[1, 0, 2], acceleration=[0, 0, -10], bounce_time=0.5, restitution=restitution)
    _, d = models.evaluate(model, np.linspace(0.0, 100.0, 4001))
    floor = 2 * 0.5 - 0.5 * 10 * 0.5**2
    return max(float(floor - d[:, 2].min()), 0.0)


def _hits(events: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Places of a body without spin that is hit at each event. [T, 3]"""
    velocities = [-0.6 * DIAGONAL, 1.5 * np.array([1.0, 0, 0]), np.array([0, 0.8, 0.3])]
    bounds = np.r_[-np.inf, events, np.inf]
    chosen = [velocities[0], *velocities[3 - len(events) :]]
    at = events[0]
    spans = [np.clip(t, low, high) - np.clip(at, low, high) for low, high in zip(bounds, bounds[1:], strict=False)]
    return sum((span[:, None] * v for span, v in zip(spans, chosen, strict=True)), np.zeros((len(t), 3)))


def _miss(events: np.ndarray, poses: int, until: float | None) -> float:
    """Error of the prediction of the last poses, in radii.

    Args:
        events: Times of the hits, each in a gap between poses.
        poses: Number of the poses.
        until: Time of the prediction; None for the last time at which the motion counts as predictable, at most a
            quarter of the span past t_max.
    """
    times = TIMES[-poses:]
    path = _hits(events, times)
    fit = model_selection.fit(times, rotations.identity(poses), path - path[-1], radius=RADIUS)
    if until is None:
        assert fit.history.band is not None
        until = min(fit.history.band.predictable_until or math.inf, 1.25 * T_MAX)
    _, d = models.evaluate(fit.model, np.array([until - T_MAX]))
    return largest(d - (_hits(events, np.array([until])) - path[-1])) / RADIUS


def _broken(left: int, count: int) -> float:
    """Error of a body that was hit with this many poses left; several hits are closer together than a time step."""
    step = TIMES[1] - TIMES[0]
    return _miss(TIMES[-left] - 0.5 * step + 0.2 * step * np.arange(count), len(TIMES), 1.25 * T_MAX)


def _two_poses_each(count: int) -> float:
    """Error, while the motion counts as predictable, of a body with two poses before, between and after its hits."""
    step = TIMES[1] - TIMES[0]
    return _miss(TIMES[-2 * count :: 2] - 0.5 * step, 2 * count + 2, None)


CASES: tuple[Case, ...] = (
    *(
        Case(
            "drag",
            f"c dt = {damping:g}",
            "motion.models.evaluate",
            "distance from the exact place",
            1e-12,
            ROUNDING,
            functools.partial(_stiff_drag, damping),
        )
        for damping in (1e-9, 1.0, 1e3, 1e6)
    ),
    *(
        Case(
            "precession",
            f"spin of {spin:g} rad per unit: the pivot stays",
            "motion.models.evaluate",
            "distance",
            1e-9,
            ROUNDING,
            functools.partial(_fast_precession, spin),
        )
        for spin in (1.0, 1e3, 1e6)
    ),
    *(
        Case(
            "bounces",
            f"restitution {rho:g}: never below the floor",
            "motion.models.evaluate",
            "depth",
            1e-6,
            "rounding of the time of a bounce",
            functools.partial(_many_bounces, rho),
        )
        for rho in (0.0, 0.5, 0.999, 1.0)
    ),
    *(
        Case(
            "breaks",
            f"{count} within a time step, {left} poses left",
            "motion_fit.model_selection.fit",
            "error / radius",
            1e-2,
            "linear motion after the break is fitted exactly",
            functools.partial(_broken, left, count),
        )
        for left, count in ((2, 1), (3, 1), (5, 2))
    ),
    *(
        Case(
            "breaks",
            f"{count + 1} segments of two poses, while predictable",
            "motion_fit.model_selection.fit",
            "error / radius",
            band.WIDE,
            "half width of the band above which a motion is not predictable",
            functools.partial(_two_poses_each, count),
        )
        for count in (1, 2)
    ),
)
