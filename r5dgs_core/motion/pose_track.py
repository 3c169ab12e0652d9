"""Observed poses of a body in dimensionless form, for fits of motion laws.

Times are in units of the observed span and zero at t_max, lengths in units of the body's radius. Notation: S poses.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from . import rotations


@dataclass(frozen=True)
class Window:
    """Time window of a fit, and the angular frequencies that its poses can resolve.

    Attributes:
        first: Time of the first pose.
        low, high: Lowest and highest frequency of an oscillation: a quarter of a period in the window, and four poses
            per period. Less than a quarter period cannot be distinguished from a constant acceleration.
        up: Unit vector against gravity, or None if it is unknown.
    """

    first: float = -1.0
    low: float = 0.5 * math.pi
    high: float = 8 * math.pi
    up: tuple[float, float, float] | None = None

    @property
    def middle(self) -> float:
        """Middle of the window, the reference time of rates: there they hardly correlate with the other parameters."""
        return 0.5 * self.first

    @property
    def may_swing(self) -> bool:
        """True if some frequency is neither too low nor too high."""
        return self.low < self.high

    def frequency(self, logit: np.ndarray) -> np.ndarray:
        """Map an unbounded parameter to an angular frequency between `low` and `high` by the logistic function."""
        return self.low + (self.high - self.low) / (1 + np.exp(-np.clip(logit, -30, 30)))

    def frequency_logit(self, frequency: float) -> float:
        """Inverse of `frequency`."""
        share = min(max((frequency - self.low) / (self.high - self.low), 1e-3), 1 - 1e-3)
        return math.log(share / (1 - share))


@dataclass(frozen=True)
class PoseTrack:
    """Dimensionless observations.

    Attributes:
        tau: Times, <= 0 at t_max or before. [S]
        quats: Unit wxyz relative to the bind state. [S, 4]
        displacements: Displacements of the pivot. [S, 3]
        weights: Pose weights, > 0. [S]
        up: See `Window`.
    """

    tau: np.ndarray
    quats: np.ndarray
    displacements: np.ndarray
    weights: np.ndarray
    up: tuple[float, float, float] | None = None

    def __len__(self) -> int:
        return len(self.tau)

    def rows(self, index: np.ndarray | slice) -> PoseTrack:
        """Select poses by index."""
        return PoseTrack(self.tau[index], self.quats[index], self.displacements[index], self.weights[index], self.up)

    @functools.cached_property
    def window(self) -> Window:
        """Window of all poses."""
        span = float(self.tau[-1] - self.tau[0])
        highest = 0.5 * math.pi / float(np.median(np.diff(self.tau)))
        return Window(float(self.tau[0]), 0.5 * math.pi / span, highest, self.up)

    @functools.cached_property
    def turns(self) -> np.ndarray:
        """Rotation vectors between neighbours. [S - 1, 3]"""
        steps = rotations.multiply(self.quats[1:], rotations.conjugate(self.quats[:-1]))
        return rotations.quats_to_rotvecs(steps)

    @functools.cached_property
    def accumulated_rotation(self) -> np.ndarray:
        """Sum of the rotations since the first pose: an unwrapped rotation vector if the axis is fixed. [S, 3]"""
        return np.concatenate([np.zeros((1, 3)), np.cumsum(self.turns, axis=0)])

    @functools.cached_property
    def spins(self) -> np.ndarray:
        """Mean angular velocities between neighbours. [S - 1, 3]"""
        return self.turns / np.diff(self.tau)[:, None]

    @functools.cached_property
    def middles(self) -> np.ndarray:
        """Times of `spins`. [S - 1]"""
        return 0.5 * (self.tau[1:] + self.tau[:-1])

    @functools.cached_property
    def spin(self) -> np.ndarray:
        """Median of `spins`. [3]"""
        return np.median(self.spins, axis=0) if len(self) > 1 else np.zeros(3)
