"""Rigid motions from twists: exponential map, Magnus steps, log-depth products and closed forms, for numpy and torch.

Notation: a twist (w, v) moves the point x with velocity v + w x (x - o), where o is the origin of the coordinates; for
groups o is their centre at t_max, see `recentre`. The pose (q, d) maps x - o to q (x - o) q* + d. With A, B, C of
`rotations` and W = [w]_x, exp(w, v) has R = I + A W + B W^2 and d = (I + B W + C W^2) v.

Functions of single poses keep the input dtype. Functions that take steps or times compute in float64, because products
of many float32 poses drift. Tensors carry gradients, which are finite at w = 0 too.
"""

from __future__ import annotations

import math

import numpy as np

from . import rotations

Array = rotations.Array
Pose = tuple[Array, Array]
MAX_STEPS = 1 << 31  # result of `steps_needed` if no number of steps suffices


def float64(*arrays: Array) -> tuple[Array, ...]:
    """Convert arrays to float64 of one library: tensors on the device of the first tensor if there is any."""
    xp = rotations.array_namespace(*arrays)
    if xp is np:
        return tuple(np.asarray(array, np.float64) for array in arrays)
    device = next(array.device for array in arrays if xp.is_tensor(array))
    return tuple(xp.as_tensor(array, dtype=xp.float64, device=device) for array in arrays)


def v_matrix_times(w: Array, v: Array) -> Array:
    """V(w) v = (I + B W + C W^2) v, the integral of exp(w s) v over s in [0, 1]. [..., 3]

    V is also the left Jacobian of the rotation exponential: exp(phi(t)) has angular velocity V(phi) phi'.
    """
    angle2 = (w * w).sum(-1)[..., None]
    once = rotations.cross(w, v)
    b, c = rotations.versine_ratio(angle2), rotations.remainder_ratio(angle2)
    return v + b * once + c * rotations.cross(w, once)


def exp(w: Array, v: Array) -> Pose:
    """Pose after one unit of time under a constant twist; the zero twist gives exactly the identity.

    Args:
        w: Angular velocity, rad per unit, any magnitude. [..., 3]
        v: Velocity of the point at the origin. [..., 3]

    Returns:
        Unit quaternions wxyz [..., 4] and displacements [..., 3].
    """
    return rotations.rotvecs_to_quats(w), v_matrix_times(w, v)


def compose(second: Pose, first: Pose) -> Pose:
    """Pose that applies ``first``, then ``second``. ([..., 4], [..., 3])"""
    return (
        rotations.multiply(second[0], first[0]),
        rotations.rotate(second[0], first[1]) + second[1],
    )


def pose_to_matrix(pivot: np.ndarray, quat: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Map x -> p + R (x - p) + d of a pose about a pivot p, in homogeneous coordinates, numpy only.

    Args:
        pivot: The pivot p. [3]
        quat: Rotation R, wxyz. [4]
        displacement: Displacement d of the pivot. [3]

    Returns:
        The map. [4, 4] float64
    """
    result = np.eye(4)
    result[:3, :3] = rotations.quats_to_rotmats(quat)
    pivot = np.asarray(pivot, np.float64)
    result[:3, 3] = pivot + displacement - result[:3, :3] @ pivot
    return result


def matrix_to_pose(pivot: np.ndarray, matrix: np.ndarray) -> Pose:
    """Inverse of `pose_to_matrix`: unit wxyz [..., 4] and displacements of the pivot [..., 3] of maps [..., 4, 4]."""
    pivot = np.asarray(pivot, np.float64)
    turned = np.einsum("...ij,j->...i", matrix[..., :3, :3], pivot)
    return rotations.rotmats_to_quats(matrix[..., :3, :3]), turned + matrix[..., :3, 3] - pivot


def differences(a: Pose, b: Pose, length: float, angle: float) -> np.ndarray:
    """Displacements and rotation vectors from poses ``b`` to poses ``a``, in units of a length and an angle (rad).

    ([..., 4], [..., 3]) -> [..., 6]
    """
    turns = rotations.quats_to_rotvecs(rotations.multiply(a[0], rotations.conjugate(b[0])))
    return np.concatenate([(a[1] - b[1]) / length, turns / angle], axis=-1)


def recentre(
    w: Array,  # [..., 3]
    v: Array,  # [..., 3]
    eps: Array,  # [..., 3]
    a: Array,  # [..., 3]
    center: Array,  # [..., 3]
) -> tuple[Array, Array]:
    """Express a twist with linear rates about another fixed origin: an exact change of variables.

    Args:
        w: Angular velocity at the start, unchanged. [..., 3]
        v: Velocity of the point at the old origin. [..., 3]
        eps: Rate of w, unchanged. [..., 3]
        a: Rate of v. [..., 3]
        center: New origin in old coordinates. [..., 3]

    Returns:
        v and a about the new origin. Twists about a distant origin lose precision to cancellation.
    """
    return v + rotations.cross(w, center), a + rotations.cross(eps, center)


def product(quats: Array, displacements: Array) -> Pose:
    """Product P_n ... P_1 of the poses along axis 0 by pairwise reduction, log n deep. ([n, ..., 4], [n, ..., 3])"""
    xp = rotations.array_namespace(quats, displacements)
    while len(quats) > 1:
        even = len(quats) // 2 * 2
        left = compose((quats[1:even:2], displacements[1:even:2]), (quats[:even:2], displacements[:even:2]))
        quats = xp.concatenate([left[0], quats[even:]])
        displacements = xp.concatenate([left[1], displacements[even:]])
    return quats[0], displacements[0]


def scan(quats: Array, displacements: Array) -> Pose:
    """All prefix products P_i ... P_1 along axis 0 by doubling. ([n, ..., 4], [n, ..., 3]) -> the same shapes"""
    xp = rotations.array_namespace(quats, displacements)
    stride = 1
    while stride < len(quats):
        later = compose((quats[stride:], displacements[stride:]), (quats[:-stride], displacements[:-stride]))
        quats = xp.concatenate([quats[:stride], later[0]])
        displacements = xp.concatenate([displacements[:stride], later[1]])
        stride *= 2
    return quats, displacements


def step_twists(
    w: Array,  # [3]
    v: Array,  # [3]
    eps: Array,  # [3]
    a: Array,  # [3]
    durations: Array,  # [...]
    steps: int,
    order: int = 4,
) -> Pose:
    """Exponents of the Magnus steps of a twist that is linear in time.

    Args:
        w: Angular velocity at time 0. [3]
        v: Velocity of the point at the origin at time 0. [3]
        eps: Rate of w. [3]
        a: Rate of v. [3]
        durations: Signed durations T. [...]
        steps: Number n >= 1 of equal steps for each T.
        order: 2 for exp(h m) with the midpoint twist m, 4 for exp(h m - h^3/12 [m, b]) with b = (eps, a).

    Returns:
        Angular and linear parts of the exponents. [n, ..., 3] each

    Source: Magnus expansion; for a linear twist Omega_1 = h m and Omega_2 = -h^3/12 [m, b] need no quadrature.
    """
    w, v, eps, a, durations = float64(w, v, eps, a, durations)
    h = (durations / steps)[None, ..., None]
    numbers, _ = float64(np.arange(steps), h)
    middles = (numbers + 0.5).reshape(steps, *([1] * (h.ndim - 1))) * h
    mw, mv = w + middles * eps, v + middles * a
    if order == 2:
        return h * mw, h * mv
    if order != 4:
        raise ValueError(f"order: expected 2 or 4, got {order}")
    bracket = _bracket((mw, mv), (eps + 0 * mw, a + 0 * mv))
    return h * mw - h**3 / 12 * bracket[0], h * mv - h**3 / 12 * bracket[1]


def integrate(w: Array, v: Array, eps: Array, a: Array, durations: Array, steps: int, order: int = 4) -> Pose:
    """Poses after ``durations`` under a twist that is linear in time, by ``steps`` Magnus steps each.

    Rigid to rounding and reversible at any step size. Arguments as in `step_twists`.

    Returns:
        Unit quaternions [..., 4] and displacements [..., 3]; exactly the identity for a duration of 0.
    """
    quats, displacements = product(*exp(*step_twists(w, v, eps, a, durations, steps, order)))
    return rotations.normalize(quats), displacements


def steps_needed(
    w: Array, v: Array, eps: Array, a: Array, durations: Array, radius: float, tolerance: float
) -> np.ndarray:
    """Number of Magnus-4 steps that keep the error of every point of a body under ``tolerance``.

    Args:
        w: Angular velocity at time 0, about the body's centre. [3]
        v: Velocity of the centre. [3]
        eps: Rate of w. [3]
        a: Rate of v. [3]
        durations: Signed durations. [...]
        radius: Radius of the body.
        tolerance: Maximum position error, in the units of radius.

    Returns:
        n >= 1 for each duration, numpy. It is 1 if twist and rate commute, because one step is then exact, and
        `MAX_STEPS` if that many do not suffice or the rates are not finite. [...] int64

    Source: leading omitted term D = [C1, a2]/240 + [a1, [a1, C1]]/720 with C1 = [a1, a2], a1 = m, a2 = b at h = 1:
        n = ceil((c T^5 / tol)^(1/4)), c the mean over [0, T] of radius |D_w| + |D_v|; at least |w| T / 2 steps.
    """
    w, v, eps, a, durations = (_numbers(x) for x in (w, v, eps, a, durations))
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
    count = np.where(commutes, 1, np.maximum(1, np.maximum(by_error, by_turn)))
    return np.nan_to_num(np.minimum(count, MAX_STEPS), nan=MAX_STEPS).astype(np.int64)


def _numbers(values: Array) -> np.ndarray:
    """Convert to float64 numpy, without gradients."""
    return float64(values)[0] if rotations.array_namespace(values) is np else values.detach().cpu().double().numpy()


def _reach(twist: Pose, radius: float) -> np.ndarray:
    """Speed that a twist gives to the farthest point, averaged over axis 0. [n, ..., 3] each -> [...]"""
    return np.mean(radius * np.linalg.norm(twist[0], axis=-1) + np.linalg.norm(twist[1], axis=-1), axis=0)


def _bracket(x: Pose, y: Pose) -> Pose:
    """Lie bracket [(w1, v1), (w2, v2)] = (w1 x w2, w1 x v2 - w2 x v1)."""
    return rotations.cross(x[0], y[0]), rotations.cross(x[0], y[1]) - rotations.cross(y[0], x[1])


def phi_2_times(w: Array, v: Array) -> Array:
    """phi_2([w]) v = (I/2 + C W + D W^2) v, the double integral of exp(w s) v over 0 <= s <= s' <= 1. [..., 3]

    With D = (x^2/2 - 1 + cos x)/x^4, x = |w|.
    """
    xp = rotations.array_namespace(w)
    angle2 = (w * w).sum(-1)[..., None]
    c = rotations.remainder_ratio(angle2)
    small = angle2 < 1.0
    low, high = xp.where(small, angle2, 0 * angle2), xp.where(small, 1 + 0 * angle2, angle2)
    series = sum((-low) ** k / math.factorial(2 * k + 4) for k in range(9))
    d = xp.where(small, series, (0.5 - rotations.versine_ratio(high)) / high)
    once = rotations.cross(w, v)
    return 0.5 * v + c * once + d * rotations.cross(w, once)


def accelerated_spin(w: Array, v: Array, a: Array, durations: Array) -> Pose:
    """Closed form of a twist with constant w and linear v: R = exp(w T), d = T phi_1 v + T^2 phi_2 a.

    Args:
        w: Angular velocity. [3]
        v: Velocity of the point at the origin at time 0. [3]
        a: Rate of v. [3]
        durations: Signed times T. [...]
    """
    w, v, a, durations = float64(w, v, a, durations)
    span = durations[..., None]
    turn = w * span
    d = span * v_matrix_times(turn, v + 0 * turn)
    return rotations.rotvecs_to_quats(turn), d + span**2 * phi_2_times(turn, a + 0 * turn)


def without_spin(poses: np.ndarray, axes: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Return the poses of a body without its rotation about unseen axes; its centre moves as before.

    Args:
        poses: Poses, rotation wxyz first. [S, 7]
        axes: Unseen axes, in the body. [K, 3]
        center: Centre of the body relative to the pivot of the poses. [3]
    """
    quats = rotations.normalize(poses[:, :4])
    if len(axes) == 3:
        left = rotations.identity(len(poses))
    else:
        twist = np.concatenate([quats[:, :1], (quats[:, 1:] @ axes[0])[:, None] * axes[0]], axis=1)
        length = np.linalg.norm(twist, axis=1, keepdims=True)
        twist = np.where(length > 1e-9, twist / np.maximum(length, 1e-9), rotations.identity(len(poses)))
        left = rotations.multiply(quats, rotations.conjugate(twist))
    result = poses.copy()
    result[:, :4] = left
    result[:, 4:] += rotations.rotate(quats, np.broadcast_to(center, (len(poses), 3)))
    result[:, 4:] -= rotations.rotate(left, np.broadcast_to(center, (len(poses), 3)))
    return result
