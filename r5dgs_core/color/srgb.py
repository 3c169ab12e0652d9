"""The sRGB transfer curve (IEC 61966-2-1). Values above 1 are kept; negative values become 0. Arrays of any shape."""

from __future__ import annotations

import numpy as np


def to_linear(srgb: np.ndarray) -> np.ndarray:
    """Convert display-referred sRGB to linear light."""
    srgb = np.maximum(srgb, 0)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def from_linear(linear: np.ndarray) -> np.ndarray:
    """Convert linear light to display-referred sRGB."""
    linear = np.maximum(linear, 0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
