"""Recolouring Gaussians: a factor on their display-referred colour, exact for every viewing direction."""

from __future__ import annotations

import numpy as np

from ..scene import spherical_harmonics


def tint_sh(sh: np.ndarray, tint: np.ndarray) -> np.ndarray:
    """Harmonics whose colour is that of ``sh`` times a factor per channel, from every direction.

    The colour of 3DGS is 0.5 + sum_k Y_k sh_k, so the 0.5 has to be multiplied too. The clamp at 0 stays where it was.

    Args:
        sh: Coefficients, 3DGS convention, display-referred sRGB. [..., K, 3]
        tint: Factors, at least 0, display-referred sRGB. [3], or [..., 3] for one each

    Returns:
        Coefficients, same dtype as ``sh``; ``sh`` itself where the factor is 1 throughout. [..., K, 3]
    """
    if (np.asarray(tint) == 1.0).all():
        return sh
    factor = np.asarray(tint, np.float64)[..., None, :]
    tinted = factor * sh.astype(np.float64)
    tinted[..., :1, :] += 0.5 * (factor - 1.0) / spherical_harmonics.C0
    return tinted.astype(sh.dtype)
