"""Real spherical harmonics to degree 3: how the colour of a Gaussian depends on the direction it is seen from.

The basis has the order and signs of 3DGS files: K = (degree + 1)^2 functions, ordered by degree l and then by order
m = -l .. l, with the Condon-Shortley sign (the three linear terms are -y, z, -x). Colours are display-referred sRGB and
carry an offset of one half, so that all-zero coefficients are middle grey. One code serves numpy and torch.
"""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np

from ..motion import rotations

Array = Any  # np.ndarray or torch.Tensor

MAX_DEGREE = 3
_ROTATED_AT_ONCE = 4096
_TURN = np.pi * (1 + 5**0.5) * (np.arange(48) + 0.5)
_HEIGHT = 1 - (2 * np.arange(48) + 1) / 48
# Directions spread evenly over the sphere. [48, 3]
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
    """The degree with ``count`` basis functions: 1, 4, 9, 16 give 0, 1, 2, 3. ValueError for any other count."""
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
        Their values, same library and dtype as ``directions``. [..., (degree + 1) ** 2]
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
    return _library(directions).stack(values, -1)


def evaluate(sh: Array, directions: Array) -> Array:
    """Sum of coefficients times basis functions, without offset and clamp.

    Args:
        sh: Coefficients of each colour channel; K = 1, 4, 9 or 16. [..., K, 3]
        directions: Unit vectors from the camera to the Gaussian, world frame. [..., 3]

    Returns:
        Colour minus one half. [..., 3]
    """
    degree = degree_of(sh.shape[-2])
    if degree == 0:  # independent of the direction: no basis to evaluate
        return C0 * sh[..., 0, :]
    return (basis(directions, degree)[..., None] * sh).sum(-2)


def to_rgb(sh: Array, directions: Array) -> Array:
    """Display-referred colour seen along ``directions``: 0.5 + `evaluate`, not clamped. [..., K, 3] -> [..., 3]"""
    return 0.5 + evaluate(sh, directions)


def rgb_to_dc(rgb: Array) -> Array:
    """Coefficient of degree 0 that shows this display-referred colour from everywhere. [..., 3] -> [..., 3]"""
    return (rgb - 0.5) / C0


def dc_to_rgb(dc: Array) -> Array:
    """Inverse of `rgb_to_dc`: the colour averaged over all directions. [..., 3] -> [..., 3]"""
    return 0.5 + C0 * dc


def rotate(sh: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """Coefficients of colours that turn with their body: the result seen along d is ``sh`` seen along R^T d.

    Bands do not mix, so the change of basis is exact; it is solved from more directions than there are functions.

    Args:
        sh: Coefficients. [N, K, C]
        quats: Rotations R, unit wxyz, one for all or one for each. [4] or [N, 4]

    Returns:
        Coefficients in the turned frame, float64. [N, K, C]
    """
    degree = degree_of(sh.shape[-2])
    if degree == 0 or len(sh) == 0:
        return sh.astype(np.float64)
    inverse = np.linalg.pinv(basis(_DIRECTIONS, degree))  # [K, P]
    result = np.empty(sh.shape, np.float64)
    for start in range(0, len(sh), _ROTATED_AT_ONCE):
        rows = slice(start, start + _ROTATED_AT_ONCE)
        back = rotations.conjugate(quats if quats.ndim == 1 else quats[rows, None])
        change = inverse @ basis(rotations.rotate(back, _DIRECTIONS), degree)
        result[rows] = change @ sh[rows]
    return result


def _library(array: Array):
    """The module that made the array: torch where it is a tensor (torch is then loaded already), else numpy."""
    torch = sys.modules.get("torch")
    return torch if torch is not None and isinstance(array, torch.Tensor) else np
