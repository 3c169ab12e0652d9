"""Initial sky: a smooth function of the viewing direction behind everything.

Rays that miss the supporting plane and share one smooth colour function are sky. The function is fitted from the
highest rays downwards, and is accepted only if enough of these rays agree with it.

Notation: P rays.
"""

from __future__ import annotations

import numpy as np

from ...scene import spherical_harmonics

DEGREE = 2
AGREES = 0.025  # maximum colour difference at which a ray is sky
MIN_SHARE = 0.25  # share of the candidate rays that must agree
ROUNDS = 6


def fit(
    directions: np.ndarray, colors: np.ndarray, candidates: np.ndarray, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Fit the sky to rays.

    Args:
        directions: Unit viewing directions, world. [P, 3]
        colors: Colours of the rays, in [0, 1]. [P, 3]
        candidates: Rays that may show sky: those that miss the supporting plane. [P] bool
        up: Mean upward direction of the cameras, unit. [3]

    Returns:
        Coefficients [9, 3] and a mask of the rays that show sky [P] bool; None if there is no smooth sky (indoors).
    """
    if candidates.sum() < 50:
        return None
    basis = spherical_harmonics.basis(directions, DEGREE)
    height = directions @ up
    inliers = candidates & (height >= np.quantile(height[candidates], 0.7))
    coefficients = np.zeros((basis.shape[1], 3))
    distance = np.zeros(len(directions))
    for _ in range(ROUNDS):
        # A little damping keeps bands that the rays do not reach at zero.
        system = basis[inliers].T @ basis[inliers] + 1e-5 * inliers.sum() * np.diag(_damping())
        coefficients = np.linalg.solve(system, basis[inliers].T @ (colors[inliers] - 0.5))
        distance = np.abs(basis @ coefficients + 0.5 - colors).max(1)
        inliers = candidates & (distance < 2 * AGREES)
        if inliers.sum() < 50:
            return None
    sky = candidates & (distance < AGREES)
    if sky.sum() < MIN_SHARE * candidates.sum():
        return None
    return coefficients, sky


def _damping() -> np.ndarray:
    """Weight of the damping per basis function; 0 for the constant. [9]"""
    degrees = np.repeat(np.arange(DEGREE + 1), 2 * np.arange(DEGREE + 1) + 1)
    return degrees.astype(np.float64) ** 2
