"""Per-point dynamics past t_max: each point follows its own twist, which is linear in time.

Notation: N points; the state of a point is ``v, w, a, e``: velocity of the point at the origin of the coordinates,
angular velocity, and the rates of both. The velocity at p is v + a tau + (w + e tau) x p. About its own centre, a
Gaussian's v and a are those of its centre (`se3.recentre`).
"""

from __future__ import annotations

import functools
import logging
import math
from typing import Any

import numpy as np

from . import rotations, twist_propagation

log = logging.getLogger(__name__)

Array = rotations.Array
MAX_TURN = 0.1  # rad per midpoint step; if larger, x, bodies grow visibly, by the factor sqrt(1 + x^4 / 4) per step
TRACE_STEP = 1 / 60  # TRACE's playback step, in units of time


def time_unit(first: float, last: float) -> float:
    """Unit of time for step lengths.

    1 if the observed times fill at least a quarter of [0, 1] (as in the paper's data), else the observed span.
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
    duration: Any,
    step: float,
) -> tuple[Array, Array]:
    """Integrate points by the midpoint rule and rotations by exponentials of the midpoint spin: TRACE's integrator.

    Points and rotations are integrated separately, so a body is rigid only to second order in the step; `propagate`
    keeps it exactly rigid. Supports numpy and torch. For numpy arrays it warns, once per step length, about
    rotations of more than `MAX_TURN` per step, because bodies then grow visibly in playback.

    Args:
        points: Start positions. [..., 3]
        v: Velocity of the point at the origin. [..., 3]
        w: Angular velocity, rad per unit. [..., 3]
        a: Rate of v. [..., 3]
        e: Rate of w. [..., 3]
        duration: Signed duration; a tensor [] is one step.
        step: Longest step; the last one is shorter.

    Returns:
        Points [..., 3] and rotations since the start, unit wxyz [..., 4].

    Source: TRACE's explicit midpoint rule.
    """
    quats = rotations.rotvecs_to_quats(0 * points)
    one_step = rotations.array_namespace(duration) is not np
    steps: list = [duration] if one_step else step_sizes(duration, step)
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

    For more than one time, keep a `twist_propagation.Propagator`.

    Args:
        dynamics: Velocity, angular velocity and the rates of both about the centre of each point, side by side. [N, 12]
        duration: Signed duration.
        tolerance: Maximum error of a point, in the units of its velocity times time.

    Returns:
        Unit quaternions wxyz [N, 4] and displacements [N, 3], float64. Exactly the identity for a duration of 0, for
        points at rest and, with a warning, for points whose dynamics or poses are not finite. Such points do not affect
        the others.
    """
    return twist_propagation.Propagator(dynamics, tolerance).rows_of(duration)


@functools.cache
def _warn_of_coarse_steps(step: float) -> None:
    log.warning(
        "TRACE's midpoint steps of %g turn points by more than %g rad each, so bodies grow visibly; "
        "remedy: use a mode other than rigid_paper, or shorter steps",
        step,
        MAX_TURN,
    )


def step_sizes(duration: float, step: float) -> list[float]:
    """Signed steps that add up to a duration: full steps and a shorter last one; empty for a duration of 0.

    Steps are counted in advance, because accumulating the time eventually misses or repeats a step.
    """
    count = max(1, math.ceil(abs(duration) / step - 1e-9)) if duration != 0 else 0
    if count == 0:
        return []
    whole = math.copysign(step, duration)
    return [whole] * (count - 1) + [duration - whole * (count - 1)]
