"""Colours of bodies that turn in fixed light, taken over from one state of a body to another.

With shading vectors g, light l and a factor r at rest the colour is c max(0, r + (R^T l - l) . g) for a rotation R
since the first state; training has r = 1. Seen from a state that is turned by Q, with b = r + (Q^T l - l) . g, the
same colours are those of c b, Q g / b and 1. Where b is small or below 0, as on what turns away from the light, they
are those of c s, Q g / s and b / s with a small s: dark now, and lit as it was trained when it turns back.
"""

from __future__ import annotations

import numpy as np

from ...motion import rotations
from ...scene import sh_color

MIN_FACTOR = 0.1  # the s above


def rebind(
    sh: np.ndarray, shading: np.ndarray, rest: np.ndarray, quats: np.ndarray, light: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours, shading vectors and factors at rest as seen from a turned state; no colour changes by it.

    Args:
        sh: Harmonics, in the frame of the new state already (`sh_color.rotate`). [N, K, 3]
        shading: The vectors g. [N, 3]
        rest: The factors r. [N]
        quats: Rotation Q from the old state to the new one, unit wxyz, one for all or one for each. [4] or [N, 4]
        light: The vector l. [3]

    Returns:
        Harmonics [N, K, 3], vectors [N, 3] and factors at rest [N] of the new state.
    """
    change = rotations.rotate(rotations.conjugate(quats), light) - light
    factor = rest + (shading * change).sum(-1)
    scale = np.maximum(factor, MIN_FACTOR)
    colored = sh * scale[:, None, None]
    # The offset of one half scales too: dc_to_rgb(dc') = scale * dc_to_rgb(dc).
    colored[:, 0] = sh_color.rgb_to_dc(sh_color.dc_to_rgb(sh[:, 0]) * scale[:, None])
    return colored, rotations.rotate(quats, shading) / scale[:, None], factor / scale
