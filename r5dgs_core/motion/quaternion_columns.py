"""Vector and quaternion operations on columns, [3, ...] and [4, ...], faster in numpy than on rows of 3 or 4."""

from __future__ import annotations

import numpy as np


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product a x b. [3, ...] each; b has the full shape"""
    result = np.empty_like(b)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(a[j], b[k], out=result[i])
        result[i] -= a[k] * b[j]
    return result


def multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Quaternion products p q, wxyz. [4, ...] each"""
    return np.stack([
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    ])  # fmt: skip


def rotate(quats: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Rotate vectors by unit quaternions wxyz. [4, ...], [3, ...]"""
    twice = 2 * cross(quats[1:], vectors)
    return vectors + quats[0] * twice + cross(quats[1:], twice)


def direction_changes(quats: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """R^T l - l for one direction l and many rotations R. [4, n], [3] -> [3, n]"""
    w, x, y, z = quats
    a, b, c = direction
    u, v, s = b * z - c * y, c * x - a * z, a * y - b * x  # l x axis
    return 2 * np.stack([w * u - y * s + z * v, w * v - z * u + x * s, w * s - x * v + y * u])
