"""Tints of Gaussians: a factor on their display-referred colour, exact for every viewing direction."""

from __future__ import annotations

import numpy as np

from ..scene import spherical_harmonics


def tint_sh(sh: np.ndarray, tint: np.ndarray) -> np.ndarray:
    """Multiply the colour of harmonics by a factor per channel, exactly in every direction.

    The 3DGS colour is 0.5 + sum_k Y_k sh_k, so the 0.5 is multiplied too. The position of the clamp at 0 does not
    change.

    Args:
        sh: Coefficients, 3DGS convention, display-referred sRGB. [..., K, 3]
        tint: Factors >= 0, display-referred sRGB. [3], or [..., 3] for individual factors

    Returns:
        Coefficients, same dtype as ``sh``; ``sh`` itself if all factors are 1. [..., K, 3]
    """
    if (np.asarray(tint) == 1.0).all():
        return sh
    factor = np.asarray(tint, np.float64)[..., None, :]
    tinted = factor * sh.astype(np.float64)
    tinted[..., :1, :] += 0.5 * (factor - 1.0) / spherical_harmonics.C0
    return tinted.astype(sh.dtype)
