"""Colours of Gaussians from real spherical harmonics up to degree 3, and coefficients under linear maps.

The basis has the order and signs of 3DGS files: K = (degree + 1)^2 functions, ordered by degree l and then by order
m = -l .. l, with the Condon-Shortley sign (the three linear terms are -y, z, -x). Colours are display-referred sRGB
with an offset of one half, so that all-zero coefficients are mid-grey. Supports numpy and torch.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..motion import rotations

Array = Any  # np.ndarray or torch.Tensor

MAX_DEGREE = 3
_TURNED_AT_ONCE = 4096
_TURN = np.pi * (1 + 5**0.5) * (np.arange(48) + 0.5)
_HEIGHT = 1 - (2 * np.arange(48) + 1) / 48
# Evenly distributed directions (Fibonacci sphere). [48, 3]
_DIRECTIONS = np.stack(
    [np.sqrt(1 - _HEIGHT**2) * np.cos(_TURN), np.sqrt(1 - _HEIGHT**2) * np.sin(_TURN), _HEIGHT], axis=-1
)

# Normalisation constants of the real spherical harmonics, in the order of the products in `basis`.
C0 = 0.5 / math.sqrt(math.pi)
C1 = math.sqrt(3 / (4 * math.pi))
C2_XY = math.sqrt(15 / (4 * math.pi))
C2_ZZ = math.sqrt(5 / (16 * math.pi))
C2_XX_YY = math.sqrt(15 / (16 * math.pi))
C3_3 = math.sqrt(35 / (32 * math.pi))
C3_2 = math.sqrt(105 / (4 * math.pi))
C3_1 = math.sqrt(21 / (32 * math.pi))
C3_0 = math.sqrt(7 / (16 * math.pi))
C3_2_DIFFERENCE = math.sqrt(105 / (16 * math.pi))


def degree_of(count: int) -> int:
    """Degree with ``count`` basis functions: 1, 4, 9, 16 give 0, 1, 2, 3. ValueError for any other count."""
    for degree in range(MAX_DEGREE + 1):
        if (degree + 1) ** 2 == count:
            return degree
    raise ValueError(f"spherical harmonics: expected 1, 4, 9 or 16 coefficients per channel, got {count}")


def basis(directions: Array, degree: int) -> Array:
    """Evaluate the basis functions.

    Args:
        directions: Unit vectors from the camera to the Gaussian, world frame. [..., 3]
        degree: 0 to 3.

    Returns:
        Values in the library and dtype of ``directions``. [..., (degree + 1) ** 2]
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"spherical harmonics: expected a degree from 0 to {MAX_DEGREE}, got {degree}")
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    values = [0 * x + C0]
    if degree >= 1:
        values += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        values += [
            C2_XY * x * y,
            -C2_XY * y * z,
            C2_ZZ * (2 * zz - xx - yy),
            -C2_XY * x * z,
            C2_XX_YY * (xx - yy),
        ]
        if degree >= 3:
            values += [
                -C3_3 * y * (3 * xx - yy),
                C3_2 * x * y * z,
                -C3_1 * y * (4 * zz - xx - yy),
                C3_0 * z * (2 * zz - 3 * xx - 3 * yy),
                -C3_1 * x * (4 * zz - xx - yy),
                C3_2_DIFFERENCE * z * (xx - yy),
                -C3_3 * x * (xx - 3 * yy),
            ]
    return rotations.array_namespace(directions).stack(values, -1)


def evaluate(sh: Array, directions: Array) -> Array:
    """Sum of coefficients times basis functions, without offset and clamp.

    Args:
        sh: Coefficients of each colour channel; K = 1, 4, 9 or 16. [..., K, 3]
        directions: Unit vectors from the camera to the Gaussian, world frame. [..., 3]

    Returns:
        Colour minus one half. [..., 3]
    """
    degree = degree_of(sh.shape[-2])
    if degree == 0:  # independent of the direction
        return C0 * sh[..., 0, :]
    return (basis(directions, degree)[..., None] * sh).sum(-2)


def to_rgb(sh: Array, directions: Array) -> Array:
    """Display-referred colour seen along ``directions``: 0.5 + `evaluate`, not clamped. [..., K, 3] -> [..., 3]"""
    return 0.5 + evaluate(sh, directions)


def rgb_to_dc(rgb: Array) -> Array:
    """Degree-0 coefficient of a display-referred colour that is the same from all directions. [..., 3] -> [..., 3]"""
    return (rgb - 0.5) / C0


def dc_to_rgb(dc: Array) -> Array:
    """Inverse of `rgb_to_dc`: the colour averaged over all directions. [..., 3] -> [..., 3]"""
    return 0.5 + C0 * dc


def change_of_basis(linear: np.ndarray, degree: int) -> np.ndarray:
    """Matrix that transforms coefficients along with an object under a linear map.

    The colour seen along d after the map is that seen along A^-1 d before it. The result is exact for rotations,
    mirrors and uniform scales, which do not mix the bands; for any other map it is a least-squares fit over all
    directions.

    Args:
        linear: A, invertible. [3, 3]
        degree: 0 to 3.

    Returns:
        The matrix. [K, K] float64
    """
    back = _DIRECTIONS @ np.linalg.inv(np.asarray(linear, np.float64)).T
    back /= np.linalg.norm(back, axis=-1, keepdims=True)
    return np.linalg.pinv(basis(_DIRECTIONS, degree)) @ basis(back, degree)


def transform(sh: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Coefficients of Gaussians transformed by a linear map, see `change_of_basis`.

    Args:
        sh: Coefficients. [N, K, C]
        linear: A, invertible. [3, 3]

    Returns:
        Coefficients, same dtype; ``sh`` itself for degree 0. [N, K, C]
    """
    degree = degree_of(sh.shape[-2])
    if degree == 0 or len(sh) == 0:
        return sh
    change = change_of_basis(linear, degree)
    # One product over all Gaussians and channels: [K, K] @ [K, N C].
    columns = np.moveaxis(sh, 1, 0).reshape(sh.shape[1], -1)
    turned = (change @ columns).reshape(sh.shape[1], sh.shape[0], sh.shape[2])
    return np.ascontiguousarray(np.moveaxis(turned, 0, 1), sh.dtype)


def rotate(sh: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """Rotate coefficients with their body: the result seen along d is ``sh`` seen along R^T d.

    Exact, because rotations do not mix bands. The change of basis is solved from more directions than there are
    functions.

    Args:
        sh: Coefficients. [N, K, C]
        quats: Rotations R, unit wxyz, one for all or one for each. [4] or [N, 4]

    Returns:
        Rotated coefficients, float64. [N, K, C]
    """
    degree = degree_of(sh.shape[-2])
    if degree == 0 or len(sh) == 0:
        return sh.astype(np.float64)
    inverse = np.linalg.pinv(basis(_DIRECTIONS, degree))  # [K, P]
    result = np.empty(sh.shape, np.float64)
    for start in range(0, len(sh), _TURNED_AT_ONCE):
        rows = slice(start, start + _TURNED_AT_ONCE)
        back = rotations.conjugate(quats if quats.ndim == 1 else quats[rows, None])
        change = inverse @ basis(rotations.rotate(back, _DIRECTIONS), degree)
        result[rows] = change @ sh[rows]
    return result
