"""Rigid motion of points over several times, by least squares.

Notation: R points, S times.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import rotations


@dataclass(frozen=True)
class RigidPath:
    """Rigid motion x -> R_s x + t_s of points at the reference time: rotations [S, 3, 3] and shifts [S, 3]."""

    rotmats: np.ndarray
    shifts: np.ndarray

    def residuals(self, paths: np.ndarray, reference: int) -> np.ndarray:
        """Return the root mean squared distance over time of points from this motion. [R, S, 3] -> [R]"""
        put = np.einsum("sij,rj->rsi", self.rotmats, paths[:, reference]) + self.shifts
        return np.sqrt(((put - paths) ** 2).sum(-1).mean(-1))


def fit(paths: np.ndarray, weights: np.ndarray, reference: int) -> RigidPath:
    """Fit rigid motions from the points at one time to those at each time (least squares, Kabsch).

    Args:
        paths: Positions over time. [..., R, S, 3]
        weights: Weights of the points, with a positive sum. [..., R]
        reference: Index of the time at which the motion starts.

    Returns:
        The motion, with the leading dimensions of ``paths``.
    """
    share = (weights / weights.sum(-1, keepdims=True))[..., None, None]
    centers = (share * paths).sum(-3)  # [..., S, 3]
    arms = paths - centers[..., None, :, :]
    spread = np.einsum("...rsi,...rj->...sij", share * arms, arms[..., reference, :])
    rotmats = rotations.nearest_rotmats(spread)
    home = centers[..., reference, :]
    return RigidPath(rotmats, centers - np.einsum("...sij,...j->...si", rotmats, home))
