"""Shading of Gaussians that rotate in fixed light.

With the factor r in the bind state, the shading vector g and the light direction l, the colour of a Gaussian that has
rotated by R since the bind state is multiplied by max(r + g . (R^T l - l), 0): to first order, diffuse shading.
"""

from __future__ import annotations

import numpy as np

from .scene import Scene


def rest_factors(scene: Scene) -> np.ndarray:
    """Factor r of each Gaussian, before clamping at 0. [N] float32"""
    rest = None if scene.shading is None else scene.shading.rest
    return np.ones(len(scene.gaussians.means), np.float32) if rest is None else rest


def light_change(light: np.ndarray, rotmats: np.ndarray) -> np.ndarray:
    """Change R^T l - l of the light direction as seen from rotated Gaussians. [3] and [..., 3, 3] -> [..., 3]"""
    return np.swapaxes(rotmats, -1, -2) @ light - light


def factors(rest: np.ndarray, vectors: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Colour factors of rotated Gaussians.

    Args:
        rest: Factors r in the bind state. [n]
        vectors: Shading vectors g. [n, 3]
        change: Change of the light direction, one for all or one for each. [3] or [n, 3]

    Returns:
        The factors, >= 0. [n]
    """
    if change.ndim == 1:
        gain = vectors @ change
    else:  # by column, because numpy is slow on rows of three
        gain = vectors[:, 0] * change[:, 0] + vectors[:, 1] * change[:, 1] + vectors[:, 2] * change[:, 2]
    return (rest + gain).clip(min=0)
