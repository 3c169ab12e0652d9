"""Shading of bodies that turn in fixed light, and its transfer from one state of a body to another.

With shading vectors g, light l and a factor r at rest, the colour is c max(0, r + (R^T l - l) . g) for a rotation R
since the first state; training has r = 1. From a state turned by Q, with b = r + (Q^T l - l) . g, the same colours are
given by c b, Q g / b and 1. If b is small or negative, as on surfaces that face away from the light, they are given by
c s, Q g / s and b / s with a small s: dark now, but lit as in training after turning back.

`scene.diffuse_shading` clamps the same factors when a scene is played.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from ...motion import rotations
from ...motion.rotations import Array
from ...scene import spherical_harmonics

MIN_FACTOR = 0.1  # the s above


def seen_light(quats: Array, light: Array) -> Array:
    """Return R^T l, the light as seen from turned bodies.

    Args:
        quats: Rotations R, unit wxyz. [..., 4]
        light: The vector l, one for all or one for each. [3] or [..., 3]

    Returns:
        Directions. [..., 3]
    """
    return rotations.rotate(rotations.conjugate(quats), light)


def unclamped_factors(rest: float | Array, shading: Array, seen: Array, light: Array) -> Array:
    """Return r + (R^T l - l) . g, before clamping at 0; numpy or torch.

    Args:
        rest: The factor r, one for all or one for each. [N]
        shading: The vectors g. [N, 3]
        seen: R^T l, see `seen_light`; one for all or one for each. [3] or [N, 3]
        light: The vector l. [3]

    Returns:
        The factors. [N]
    """
    return rest + (shading * (seen - light)).sum(-1)


def shade_rows(colors: Tensor, rows: Tensor, factor: Tensor) -> Tensor:
    """Return colours with those of some rows multiplied by their factors; both are clamped at 0.

    Args:
        colors: Colours of all Gaussians. [N, 3]
        rows: Rows to shade. [n] int64
        factor: Their factors. [n]
    """
    return colors.index_copy(0, rows, colors[rows].clamp(min=0) * factor[:, None].clamp(min=0))


def rebind(
    sh: np.ndarray, shading: np.ndarray, rest: np.ndarray, quats: np.ndarray, light: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colours, shading vectors and factors at rest for a turned state; all rendered colours stay the same.

    Args:
        sh: Harmonics, already in the frame of the new state (`spherical_harmonics.rotate`). [N, K, 3]
        shading: The vectors g. [N, 3]
        rest: The factors r. [N]
        quats: Rotation Q from the old state to the new one, unit wxyz, one for all or one for each. [4] or [N, 4]
        light: The vector l. [3]

    Returns:
        Harmonics [N, K, 3], vectors [N, 3] and factors at rest [N] of the new state.
    """
    factor = unclamped_factors(rest, shading, seen_light(quats, light), light)
    scale = np.maximum(factor, MIN_FACTOR)
    colored = sh * scale[:, None, None]
    # The offset of one half scales too: dc_to_rgb(dc') = scale * dc_to_rgb(dc).
    colored[:, 0] = spherical_harmonics.rgb_to_dc(spherical_harmonics.dc_to_rgb(sh[:, 0]) * scale[:, None])
    return colored, rotations.rotate(quats, shading) / scale[:, None], factor / scale
