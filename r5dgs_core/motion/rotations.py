"""Quaternions, rotation matrices and rotation vectors, for numpy and torch alike.

Notation: quaternions are wxyz, Hamilton, active (q v q* rotates v) and unit; rotation vectors are axis times angle in
radians; matrices act on columns. Leading batch dimensions broadcast. Near zero angle every function is a series in the
squared angle, which keeps precision and finite gradients.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

Array = Any  # numpy.ndarray or torch.Tensor

# Below this squared angle the nine Taylor terms are exact to rounding (the tenth is under 1e-17); above it the closed
# forms lose at most two digits.
_SERIES_LIMIT = 1.0
_COS_SERIES = (
    1.0,
    -1 / 2,
    1 / 24,
    -1 / 720,
    1 / 40320,
    -1 / 3628800,
    1 / 479001600,
    -1 / 87178291200,
    1 / 20922789888000,
)
_SIN_SERIES = tuple(c / (2 * k + 1) for k, c in enumerate(_COS_SERIES))  # sin(x)/x
_B_SERIES = tuple(c / (2 * k + 2) for k, c in enumerate(_SIN_SERIES))  # (1 - cos x)/x^2
_C_SERIES = tuple(c / (2 * k + 3) for k, c in enumerate(_B_SERIES))  # (x - sin x)/x^3


def array_namespace(*arrays: Array) -> Any:
    """Return the library of the arrays: torch if any is a tensor, else numpy. Never imports torch."""
    torch = sys.modules.get("torch")
    if torch is not None and any(isinstance(array, torch.Tensor) for array in arrays):
        return torch
    return np


def _horner(coefficients: tuple[float, ...], x: Array) -> Array:
    total = coefficients[-1] + 0 * x
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total


def _split(angle2: Array) -> tuple[Any, Array, Array, Array]:
    """Safe arguments of a series for small angles and of the closed form for others.

    `where` also differentiates the branch that it discards, so each branch needs a safe argument.

    Returns:
        Mask of small angles; squared angles, 0 if not small; squared angles, 1 if small; square roots of the latter.
    """
    xp = array_namespace(angle2)
    small = angle2 < _SERIES_LIMIT
    low = xp.where(small, angle2, xp.zeros_like(angle2))
    high = xp.where(small, xp.ones_like(angle2), angle2)
    return small, low, high, xp.sqrt(high)


def cosine(angle2: Array) -> Array:
    """cos(x) as a function of x^2. [...]"""
    xp = array_namespace(angle2)
    if xp is np:  # only gradients need the series
        return np.cos(np.sqrt(angle2))
    small, low, _, root = _split(angle2)
    return xp.where(small, _horner(_COS_SERIES, low), xp.cos(root))


def sine_ratio(angle2: Array) -> Array:
    """A = sin(x)/x as a function of x^2. [...]"""
    xp = array_namespace(angle2)
    if xp is np:
        root = np.sqrt(angle2)
        safe = np.where(root > 0, root, 1.0)
        return np.where(root > 0, np.sin(safe) / safe, 1.0).astype(root.dtype)
    small, low, _, root = _split(angle2)
    return xp.where(small, _horner(_SIN_SERIES, low), xp.sin(root) / root)


def versine_ratio(angle2: Array) -> Array:
    """B = (1 - cos x)/x^2 as a function of x^2. [...]"""
    xp = array_namespace(angle2)
    small, low, high, root = _split(angle2)
    half = xp.sin(0.5 * root)
    return xp.where(small, _horner(_B_SERIES, low), 2 * half * half / high)


def remainder_ratio(angle2: Array) -> Array:
    """C = (x - sin x)/x^3 as a function of x^2. [...]"""
    xp = array_namespace(angle2)
    small, low, high, root = _split(angle2)
    return xp.where(small, _horner(_C_SERIES, low), (root - xp.sin(root)) / (high * root))


def cross(a: Array, b: Array) -> Array:
    """Cross product a x b with broadcasting. [..., 3] each"""
    xp = array_namespace(a, b)
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return xp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)


def skew(vectors: np.ndarray) -> np.ndarray:
    """Matrices [v]_x of the cross products v x. [..., 3] -> [..., 3, 3]"""
    matrices = np.zeros((*vectors.shape[:-1], 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrices[..., j, i], matrices[..., i, j] = vectors[..., k], -vectors[..., k]
    return matrices


def normalize(quats: Array) -> Array:
    """Normalise quaternions; the zero quaternion becomes the identity. [..., 4]"""
    xp = array_namespace(quats)
    norm2 = (quats * quats).sum(-1)[..., None]
    zero = norm2 <= 0
    unit = quats / xp.sqrt(xp.where(zero, xp.ones_like(norm2), norm2))
    one = xp.zeros_like(quats)
    one[..., 0] = 1
    return xp.where(zero, one, unit)


def conjugate(quats: Array) -> Array:
    """Inverse of unit quaternions. [..., 4]"""
    xp = array_namespace(quats)
    return xp.concatenate([quats[..., :1], -quats[..., 1:]], -1)


def multiply(p: Array, q: Array) -> Array:
    """Hamilton product p q: rotation by q, then by p, both in the world frame. [..., 4]"""
    xp = array_namespace(p, q)
    pw, px, py, pz = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    qw, qx, qy, qz = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return xp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        -1,
    )


def rotate(quats: Array, vectors: Array) -> Array:
    """Rotate vectors by unit quaternions. [..., 4], [..., 3] -> [..., 3]"""
    axis, w = quats[..., 1:], quats[..., :1]
    twice = 2 * cross(axis, vectors)
    return vectors + w * twice + cross(axis, twice)


def rotvecs_to_quats(rotvecs: Array) -> Array:
    """Exponential map, rotation vectors to unit quaternions; zero gives exactly (1, 0, 0, 0). [..., 3] -> [..., 4]"""
    xp = array_namespace(rotvecs)
    quarter = 0.25 * (rotvecs * rotvecs).sum(-1)[..., None]
    return xp.concatenate([cosine(quarter), 0.5 * sine_ratio(quarter) * rotvecs], -1)


def quats_to_rotvecs(quats: Array) -> Array:
    """Logarithm map, unit quaternions to rotation vectors of angle at most pi. [..., 4] -> [..., 3]"""
    xp = array_namespace(quats)
    flipped = xp.where(quats[..., :1] < 0, -quats, quats)
    w, vec = flipped[..., :1], flipped[..., 1:]
    norm2 = (vec * vec).sum(-1)[..., None]
    small = norm2 < 1e-8
    safe_w = xp.where(small, w, xp.ones_like(w))
    ratio2 = xp.where(small, norm2, xp.zeros_like(norm2)) / (safe_w * safe_w)
    series = 2 / safe_w * (1 - ratio2 / 3 + ratio2 * ratio2 / 5)
    norm = xp.sqrt(xp.where(small, xp.ones_like(norm2), norm2))
    return vec * xp.where(small, series, 2 * xp.arctan2(norm, w) / norm)


def quats_to_rotmats(quats: Array) -> Array:
    """Unit quaternions to rotation matrices. [..., 4] -> [..., 3, 3]"""
    xp = array_namespace(quats)
    w, x, y, z = quats[..., 0], quats[..., 1], quats[..., 2], quats[..., 3]
    rows = [
        xp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        xp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        xp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return xp.stack(rows, -2)


def rotmats_to_quats(rotmats: Array) -> Array:
    """Rotation matrices to unit quaternions with w >= 0. [..., 3, 3] -> [..., 4]

    Uses the formula for the largest of the four components. It keeps full precision at half turns, where the usual
    trace formula divides zero by zero.
    """
    xp = array_namespace(rotmats)
    m = [[rotmats[..., i, j] for j in range(3)] for i in range(3)]
    x, y, z = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    xy, xz, yz = m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]
    diagonal = xp.stack(
        [
            1 + m[0][0] + m[1][1] + m[2][2],
            1 + m[0][0] - m[1][1] - m[2][2],
            1 - m[0][0] + m[1][1] - m[2][2],
            1 - m[0][0] - m[1][1] + m[2][2],
        ],
        -1,
    )
    rows = xp.stack(
        [
            xp.stack([diagonal[..., 0], x, y, z], -1),
            xp.stack([x, diagonal[..., 1], xy, xz], -1),
            xp.stack([y, xy, diagonal[..., 2], yz], -1),
            xp.stack([z, xz, yz, diagonal[..., 3]], -1),
        ],
        -2,
    )
    index = xp.cumsum(xp.ones_like(diagonal), -1) - 1
    largest = diagonal.argmax(-1)[..., None] == index
    quats = normalize((rows * largest[..., None]).sum(-2))
    return xp.where(quats[..., :1] < 0, -quats, quats)


def nearest_rotmats(matrices: Array) -> Array:
    """Rotation matrices nearest to any matrices; for a mean of rotations, the chordal mean. [..., 3, 3]

    Source: Kabsch 1976. For the covariance sum_i w_i y_i x_i^T of centred points it is the rotation of x that fits y
        best in the sense of least squares. The smallest singular vector is flipped if needed for det = +1.
    """
    xp = array_namespace(matrices)
    u, _, vt = xp.linalg.svd(matrices)
    sign = xp.where(xp.linalg.det(u @ vt) < 0, -1.0, 1.0)
    return xp.concatenate([u[..., :2], u[..., 2:] * sign[..., None, None]], -1) @ vt


def make_continuous(quats: Array) -> Array:
    """Choose the sign of each quaternion that is nearest to its predecessor along axis 0. [S, ..., 4]

    The first keeps its sign. Without this, a track turns by up to 360 degrees between two keys of opposite sign.
    """
    xp = array_namespace(quats)
    if quats.shape[0] < 2:
        return quats
    dots = (quats[1:] * quats[:-1]).sum(-1)[..., None]
    steps = xp.where(dots < 0, -xp.ones_like(dots), xp.ones_like(dots))
    signs = xp.cumprod(xp.concatenate([xp.ones_like(steps[:1]), steps], 0), 0)
    return quats * signs


def angle_between(p: Array, q: Array) -> Array:
    """Rotation angle from p to q in radians, in [0, pi], accurate near 0 and pi. [..., 4] -> [...]"""
    xp = array_namespace(p, q)
    turn = multiply(conjugate(p), q)
    vec = turn[..., 1:]
    return 2 * xp.arctan2(xp.sqrt((vec * vec).sum(-1)), abs(turn[..., 0]))


def between_vectors(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Smallest rotation from one unit vector to another; about any normal if they are opposite. [3] -> [4]"""
    quat = np.concatenate([[1 + float(start @ end)], np.cross(start, end)])
    if np.linalg.norm(quat) < 1e-7:
        normal = np.cross(start, np.eye(3)[int(np.argmin(np.abs(start)))])
        return np.concatenate([[0.0], normal / np.linalg.norm(normal)])
    return normalize(quat)


def interpolate(p: Array, q: Array, share: float) -> Array:
    """Rotation at constant angular velocity from p (share 0) to q (share 1), which may also extrapolate. [..., 4]"""
    turn = rotvecs_to_quats(share * quats_to_rotvecs(multiply(q, conjugate(p))))
    return normalize(multiply(turn, p))


def quat_rates(quats: Array, angular_velocities: Array) -> Array:
    """Time derivative q' = (0, w) q / 2 for an angular velocity in the world frame, rad per unit. [..., 4]"""
    xp = array_namespace(quats, angular_velocities)
    pure = xp.concatenate([xp.zeros_like(angular_velocities[..., :1]), angular_velocities], -1)
    return 0.5 * multiply(pure, quats)


def identity(*shape: int) -> np.ndarray:
    """Identity quaternions, float64 numpy. [*shape, 4]"""
    quats = np.zeros((*shape, 4))
    quats[..., 0] = 1
    return quats
