"""Colours of Gaussians from real spherical harmonics up to degree 3.

The basis is that of `scene.spherical_harmonics`. Colours are display-referred sRGB with an offset of one half, so that
all-zero coefficients are mid-grey. Supports numpy and torch.
"""

from __future__ import annotations

from typing import Any

from .spherical_harmonics import (
    C0,
    C1,
    C2_XX_YY,
    C2_XY,
    C2_ZZ,
    C3_0,
    C3_1,
    C3_2,
    C3_2_DIFFERENCE,
    C3_3,
    MAX_DEGREE,
    basis,
    degree_of,
)
from .spherical_harmonics import turned as rotate

Array = Any  # np.ndarray or torch.Tensor

__all__ = (
    "C0", "C1", "C2_XX_YY", "C2_XY", "C2_ZZ", "C3_0", "C3_1", "C3_2", "C3_2_DIFFERENCE", "C3_3", "MAX_DEGREE", "basis",
    "dc_to_rgb", "degree_of", "evaluate", "rgb_to_dc", "rotate", "to_rgb",
)  # fmt: skip


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
