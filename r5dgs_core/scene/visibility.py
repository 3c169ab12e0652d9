"""Opacity threshold for Gaussians that determine a group's position."""

from __future__ import annotations

import numpy as np

SEEN_OPACITY = 0.3  # fainter Gaussians do not determine an object's position


def seen(opacities: np.ndarray) -> np.ndarray:
    """Mask of members with opacity above `SEEN_OPACITY`, or all members if none qualifies. [n] -> [n] bool"""
    visible = opacities > SEEN_OPACITY
    return visible if visible.any() else np.ones(len(opacities), bool)
