"""Cauchy weights of residuals, with a scale from their median. Sizes of residuals are >= 0."""

from __future__ import annotations

import numpy as np

MEDIAN_TO_SIGMA = 1.4826  # standard deviation of a normal distribution / median of its absolute values
OUTLYING = 4.0  # medians


def has_outliers(sizes: np.ndarray, negligible: float) -> bool:
    """Return True if the largest residual exceeds four medians and ``negligible``. [n]"""
    return bool(sizes.max() > max(OUTLYING * float(np.median(sizes)), negligible))


def cauchy_scale(sizes: np.ndarray, least: float) -> float:
    """Size at which the weight is one half: two standard deviations, at least ``least``. [n]"""
    return max(2 * MEDIAN_TO_SIGMA * float(np.median(sizes)), least)


def reweight(weights: float | np.ndarray, sizes: np.ndarray, scale: float) -> np.ndarray:
    """Cauchy weights for iteratively reweighted least squares: weights / (1 + (size / scale)^2). [n] -> [n]"""
    return weights / (1 + (sizes / scale) ** 2)


def cauchy_weights(squares: np.ndarray, softness: float) -> np.ndarray:
    """Cauchy weights of squared residuals; ``softness`` is the square at which the weight is one half. [...]"""
    return 1 / (1 + squares / softness)


def cauchy_losses(squares: np.ndarray, softness: float) -> np.ndarray:
    """Cauchy losses of squared residuals: the squares themselves if ``softness`` is infinite. [...]"""
    return squares if np.isinf(softness) else softness * np.log1p(squares / softness)
