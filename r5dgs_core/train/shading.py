"""Colours of bodies that turn in fixed light, taken over from one state of a body to another.

With shading vectors g and light l the colour is c (1 + (R^T l - l) . g) for a rotation R since the first state. Seen
from a state that is turned by Q, with b = 1 + (Q^T l - l) . g, the same colours are those of c b and Q g / b.
"""

from __future__ import annotations

import numpy as np

from ..model import spherical_harmonics
from ..motion import rotations

MIN_FACTOR = 0.1


def rebind(sh: np.ndarray, shading: np.ndarray, quats: np.ndarray, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours and shading vectors as seen from a turned state.

    Args:
        sh: Harmonics, in the frame of the new state already (`spherical_harmonics.rotate`). [N, K, 3]
        shading: The vectors g. [N, 3]
        quats: Rotation Q from the old state to the new one, unit wxyz, one for all or one for each. [4] or [N, 4]
        light: The vector l. [3]

    Returns:
        Harmonics [N, K, 3] and vectors [N, 3] of the new state.
    """
    change = rotations.rotate(rotations.conjugate(quats), light) - light
    factor = np.maximum(1 + (shading * change).sum(-1), MIN_FACTOR)
    colored = sh * factor[:, None, None]
    # The offset of one half scales too: dc_to_rgb(dc') = factor * dc_to_rgb(dc).
    colored[:, 0] = spherical_harmonics.rgb_to_dc(spherical_harmonics.dc_to_rgb(sh[:, 0]) * factor[:, None])
    return colored, rotations.rotate(quats, shading) / factor[:, None]
