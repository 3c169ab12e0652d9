"""Rigid motions from twists: exponential map, Magnus steps, log-depth products and closed forms.

Notation: a twist (w, v) moves the point x with velocity v + w x (x - o), where o is the origin of the coordinates; for
groups o is their centre at t_max, see `recentre`. The pose (q, d) maps x - o to q (x - o) q* + d. With A, B, C of
`rotations` and W = [w]_x, exp(w, v) has R = I + A W + B W^2 and d = (I + B W + C W^2) v.
"""

from __future__ import annotations

import math

import numpy as np

from . import rotations

Pose = tuple[np.ndarray, np.ndarray]


def v_matrix_times(w: np.ndarray, v: np.ndarray) -> np.ndarray:
    """V(w) v = (I + B W + C W^2) v: the integral of exp(w s) v over s in [0, 1]. [..., 3]

    It is also the left Jacobian of the rotation exponential: exp(phi(t)) has angular velocity V(phi) phi'.
    """
    angle2 = (w * w).sum(-1)[..., None]
    once = rotations.cross(w, v)
    b, c = rotations.versine_ratio(angle2), rotations.remainder_ratio(angle2)
    return v + b * once + c * rotations.cross(w, once)


def exp(w: np.ndarray, v: np.ndarray) -> Pose:
    """Pose after one unit of time under a constant twist; the zero twist gives the identity to the bit.

    Args:
        w: Angular velocity, rad per unit, any magnitude. [..., 3]
        v: Velocity of the point at the origin. [..., 3]

    Returns:
        Unit quaternions wxyz [..., 4] and displacements [..., 3].
    """
    return rotations.rotvecs_to_quats(w), v_matrix_times(w, v)


def compose(second: Pose, first: Pose) -> Pose:
    """The pose that applies ``first``, then ``second``. ([..., 4], [..., 3])"""
    return (
        rotations.multiply(second[0], first[0]),
        rotations.rotate(second[0], first[1]) + second[1],
    )


def invert(pose: Pose) -> Pose:
    """The pose that undoes ``pose``. ([..., 4], [..., 3])"""
    back = rotations.conjugate(pose[0])
    return back, -rotations.rotate(back, pose[1])


def recentre(
    w: np.ndarray,  # [..., 3]
    v: np.ndarray,  # [..., 3]
    eps: np.ndarray,  # [..., 3]
    a: np.ndarray,  # [..., 3]
    center: np.ndarray,  # [..., 3]
) -> tuple[np.ndarray, np.ndarray]:
    """Rewrite a twist with linear rates about another fixed origin: an exact change of variables.

    Args:
        w: Angular velocity at the start, unchanged by the shift. [..., 3]
        v: Velocity of the point that sits at the old origin. [..., 3]
        eps: Rate of w, unchanged. [..., 3]
        a: Rate of v. [..., 3]
        center: The new origin in old coordinates. [..., 3]

    Returns:
        v and a about the new origin. Twists about a far origin cancel badly in rounding.
    """
    return v + rotations.cross(w, center), a + rotations.cross(eps, center)


def product(quats: np.ndarray, displacements: np.ndarray) -> Pose:
    """Product P_n ... P_1 of the poses along axis 0 by halving, log n deep. ([n, ..., 4], [n, ..., 3])"""
    while len(quats) > 1:
        even = len(quats) // 2 * 2
        left = compose((quats[1:even:2], displacements[1:even:2]), (quats[:even:2], displacements[:even:2]))
        quats = np.concatenate([left[0], quats[even:]])
        displacements = np.concatenate([left[1], displacements[even:]])
    return quats[0], displacements[0]


def scan(quats: np.ndarray, displacements: np.ndarray) -> Pose:
    """All prefix products P_i ... P_1 along axis 0 by doubling. ([n, ..., 4], [n, ..., 3]) -> the same shapes"""
    stride = 1
    while stride < len(quats):
        later = compose((quats[stride:], displacements[stride:]), (quats[:-stride], displacements[:-stride]))
        quats = np.concatenate([quats[:stride], later[0]])
        displacements = np.concatenate([displacements[:stride], later[1]])
        stride *= 2
    return quats, displacements


def step_twists(
    w: np.ndarray,  # [3]
    v: np.ndarray,  # [3]
    eps: np.ndarray,  # [3]
    a: np.ndarray,  # [3]
    durations: np.ndarray,  # [...]
    steps: int,
    order: int = 4,
) -> Pose:
    """Exponents of the Magnus steps of a twist that is linear in time.

    Args:
        w: Angular velocity at time 0. [3]
        v: Velocity of the point at the origin at time 0. [3]
        eps: Rate of w. [3]
        a: Rate of v. [3]
        durations: Signed times T to reach. [...]
        steps: Equal steps n >= 1 that each T is cut into.
        order: 2 takes exp(h m) with the midpoint twist m, 4 takes exp(h m - h^3/12 [m, b]) with b = (eps, a).

    Returns:
        Angular and linear parts of the exponents. [n, ..., 3] each

    Source: Magnus expansion; for a linear twist Omega_1 = h m and Omega_2 = -h^3/12 [m, b] need no quadrature.
    """
    h = (np.asarray(durations, np.float64) / steps)[None, ..., None]
    middles = (np.arange(steps) + 0.5).reshape(steps, *([1] * (h.ndim - 1))) * h
    mw, mv = w + middles * eps, v + middles * a
    if order == 2:
        return h * mw, h * mv
    if order != 4:
        raise ValueError(f"order: expected 2 or 4, got {order}")
    bracket_w = rotations.cross(mw, np.broadcast_to(eps, mw.shape))
    bracket_v = rotations.cross(mw, np.broadcast_to(a, mv.shape)) - rotations.cross(np.broadcast_to(eps, mw.shape), mv)
    return h * mw - h**3 / 12 * bracket_w, h * mv - h**3 / 12 * bracket_v


def integrate(
    w: np.ndarray, v: np.ndarray, eps: np.ndarray, a: np.ndarray, durations: np.ndarray, steps: int, order: int = 4
) -> Pose:
    """Poses after ``durations`` under a twist that is linear in time, by ``steps`` Magnus steps each.

    Rigid to rounding and reversible at any step size; arguments as in `step_twists`.

    Returns:
        Unit quaternions [..., 4] and displacements [..., 3]; a duration of 0 gives the identity to the bit.
    """
    quats, displacements = product(*exp(*step_twists(w, v, eps, a, durations, steps, order)))
    return rotations.normalize(quats), displacements


def steps_needed(
    w: np.ndarray, v: np.ndarray, eps: np.ndarray, a: np.ndarray, durations: np.ndarray, radius: float, tolerance: float
) -> np.ndarray:
    """Magnus-4 steps that keep the error of every point of a body under ``tolerance``.

    Args:
        w: Angular velocity at time 0, about the body's centre. [3]
        v: Velocity of the centre. [3]
        eps: Rate of w. [3]
        a: Rate of v. [3]
        durations: Signed times to reach. [...]
        radius: Radius of the body.
        tolerance: Largest allowed distance, in the units of radius.

    Returns:
        n >= 1 for each duration; 1 where twist and rate commute, which one step solves exactly. [...] int64

    Source: leading omitted term D = [C1, a2]/240 + [a1, [a1, C1]]/720 with C1 = [a1, a2], a1 = m, a2 = b at h = 1:
        n = ceil((c T^5 / tol)^(1/4)), c the mean over [0, T] of radius |D_w| + |D_v|; at least |w| T / 2 steps.
    """
    durations = np.asarray(durations, np.float64)
    times = np.linspace(np.zeros_like(durations), durations, 5)[..., None]
    a1 = (w + times * eps, v + times * a)
    a2 = (eps + 0 * times, a + 0 * times)
    c1 = _bracket(a1, a2)
    first, second = _bracket(c1, a2), _bracket(a1, _bracket(a1, c1))
    omitted = _reach((first[0] / 240 + second[0] / 720, first[1] / 240 + second[1] / 720), radius)
    span = np.abs(durations)
    by_error = np.ceil((omitted * span**5 / tolerance) ** 0.25)
    by_turn = np.ceil(np.linalg.norm(a1[0], axis=-1).max(axis=0) * span / 2)
    commutes = omitted * span**5 <= 1e-15 * _reach(a1, radius) * span
    return np.where(commutes, 1, np.maximum(1, np.maximum(by_error, by_turn))).astype(np.int64)


def _reach(twist: Pose, radius: float) -> np.ndarray:
    """Mean over axis 0 of the speed that a twist gives to the farthest point. [n, ..., 3] each -> [...]"""
    return np.mean(radius * np.linalg.norm(twist[0], axis=-1) + np.linalg.norm(twist[1], axis=-1), axis=0)


def _bracket(x: Pose, y: Pose) -> Pose:
    """Lie bracket [(w1, v1), (w2, v2)] = (w1 x w2, w1 x v2 - w2 x v1)."""
    return rotations.cross(x[0], y[0]), rotations.cross(x[0], y[1]) - rotations.cross(y[0], x[1])


def phi_2_times(w: np.ndarray, v: np.ndarray) -> np.ndarray:
    """phi_2([w]) v = (I/2 + C W + D W^2) v, the double integral of exp(w s) v over 0 <= s <= s' <= 1. [..., 3]

    With D = (x^2/2 - 1 + cos x)/x^4, x = |w|.
    """
    angle2 = (w * w).sum(-1)[..., None]
    c = rotations.remainder_ratio(angle2)
    small = angle2 < 1.0
    low, high = np.where(small, angle2, 0.0), np.where(small, 1.0, angle2)
    series = sum((-low) ** k / math.factorial(2 * k + 4) for k in range(9))
    d = np.where(small, series, (0.5 - rotations.versine_ratio(high)) / high)
    once = rotations.cross(w, v)
    return 0.5 * v + c * once + d * rotations.cross(w, once)


def accelerated_spin(w: np.ndarray, v: np.ndarray, a: np.ndarray, durations: np.ndarray) -> Pose:
    """Closed form of a twist with constant w and linear v: R = exp(w T), d = T phi_1 v + T^2 phi_2 a.

    Args:
        w: Angular velocity. [3]
        v: Velocity of the point at the origin at time 0. [3]
        a: Rate of v. [3]
        durations: Signed times T. [...]
    """
    span = np.asarray(durations, np.float64)[..., None]
    turn = w * span
    d = span * v_matrix_times(turn, np.broadcast_to(v, turn.shape))
    return rotations.rotvecs_to_quats(turn), d + span**2 * phi_2_times(turn, np.broadcast_to(a, turn.shape))
