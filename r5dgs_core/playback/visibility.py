"""Which members of a group say where it is."""

from __future__ import annotations

import numpy as np

SEEN_OPACITY = 0.3  # fainter Gaussians do not say where an object is


def seen(opacities: np.ndarray) -> np.ndarray:
    """Members that can be seen; all, where none can. [n] -> [n] bool"""
    visible = opacities > SEEN_OPACITY
    return visible if visible.any() else np.ones(len(opacities), bool)
