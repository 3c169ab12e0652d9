"""Dynamics of single points past t_max: each moves by a twist of its own that changes linearly with time.

Notation: N points; the state of a point is ``v, w, a, e``: velocity of the point that sits at the origin of the
coordinates, angular velocity, and the rates of both. The velocity at p is v + a tau + (w + e tau) x p. About its own
centre a Gaussian's v and a are those of its centre (`se3.recentre`).
"""

from __future__ import annotations

import functools
import logging
import math

import numpy as np

from . import rotations, twist_propagation

log = logging.getLogger(__name__)

Array = rotations.Array
MAX_TURN = 0.1  # radians per midpoint step: beyond, distances grow visibly, by sqrt(1 + x^4 / 4) a step
TRACE_STEP = 1 / 60  # TRACE's step at playback, in units of time


def time_unit(first: float, last: float) -> float:
    """The unit of time that steps are counted in: 1 where observed times lie in [0, 1] and fill a quarter of it (as
    in the paper's data), else the observed span.
    """
    if first >= 0 and last <= 1 and last - first >= 0.25:
        return 1.0
    return last - first if last > first else 1.0


def rk2(
    points: Array,  # [..., 3]
    v: Array,  # [..., 3]
    w: Array,  # [..., 3]
    a: Array,  # [..., 3]
    e: Array,  # [..., 3]
    duration: float,
    step: float,
) -> tuple[Array, Array]:
    """Midpoint steps of the points, and exponentials of their midpoint spin: the integrator of TRACE.

    Points and rotations are integrated apart, so that a body is rigid only to second order in the step; `propagate`
    is exact in that. The same code serves numpy and torch. Warns once where numpy arrays spin by more than `MAX_TURN`
    in a step, as playback then shows bodies that grow; training, with tensors, is not asked.

    Args:
        points: Where the points start. [..., 3]
        v: Velocity of the point at the origin. [..., 3]
        w: Angular velocity, rad per unit. [..., 3]
        a: Rate of v. [..., 3]
        e: Rate of w. [..., 3]
        duration: Signed time to reach.
        step: Longest step; the last one is shorter.

    Returns:
        Points [..., 3] and rotations since the start, unit wxyz [..., 4].

    Source: TRACE's explicit midpoint rule.
    """
    quats = rotations.rotvecs_to_quats(0 * points)
    steps = step_sizes(duration, step)
    if steps and rotations.array_namespace(points, w) is np:
        rates = np.linalg.norm(np.stack(np.broadcast_arrays(w, w + e * duration)), axis=-1)
        if not abs(steps[0]) * rates.max(initial=0.0) <= MAX_TURN:
            _warn_of_coarse_steps(abs(steps[0]))
    for h in steps:
        middle = points + 0.5 * h * (v + rotations.cross(w, points))
        v, w = v + 0.5 * h * a, w + 0.5 * h * e
        points = points + h * (v + rotations.cross(w, middle))
        quats = rotations.multiply(rotations.rotvecs_to_quats(h * w), quats)
        v, w = v + 0.5 * h * a, w + 0.5 * h * e
    return points, quats


def propagate(dynamics: np.ndarray, duration: float, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and displacements of points under dynamics about their own centres, by fourth-order Magnus steps.

    For more than one time keep a `twist_propagation.Propagator`.

    Args:
        dynamics: Velocity, angular velocity and the rates of both about the centre of each point, side by side. [N, 12]
        duration: Signed time to reach.
        tolerance: Largest allowed error of a point, in the units of its velocity times time.

    Returns:
        Unit quaternions wxyz [N, 4] and displacements [N, 3], float64; the identity to the bit for a duration of 0, for
        points at rest, and, with a warning, for points whose dynamics are not finite or go beyond all numbers. What
        is wrong with one point changes no bit of the others.
    """
    return twist_propagation.Propagator(dynamics, tolerance).rows_of(duration)


@functools.cache
def _warn_of_coarse_steps(step: float) -> None:
    log.warning(
        "TRACE's midpoint steps of %g are too long for a spin of more than %g rad a step: bodies grow; "
        "remedy: another mode than rigid_paper, or shorter steps",
        step,
        MAX_TURN,
    )


def step_sizes(duration: float, step: float) -> list[float]:
    """Signed steps that fill a duration: whole ones and a last one that is no longer; none for no duration.

    Their number is counted once, as a time that is added up misses or repeats a step after a while.
    """
    count = max(1, math.ceil(abs(duration) / step - 1e-9)) if duration != 0 else 0
    if count == 0:
        return []
    whole = math.copysign(step, duration)
    return [whole] * (count - 1) + [duration - whole * (count - 1)]
