"""Observed poses of a body with their errors."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

_PLACE, _TURN = 0.01, 0.01  # errors of simulated poses after the first contact: in sizes, and rad


@dataclass(frozen=True)
class Track:
    """Observed poses of a body.

    Attributes:
        times: Increasing. [S]
        quats: Relative to the bind state. [S, 4]
        places: Centres of mass. [S, 3]
        place_noise: Standard deviation of a place per axis. [S]
        turn_noise: The same of a rotation, rad. [S]
    """

    times: np.ndarray
    quats: np.ndarray
    places: np.ndarray
    place_noise: np.ndarray
    turn_noise: np.ndarray

    def __len__(self) -> int:
        return len(self.times)

    def rows(self, rows: slice) -> Track:
        """Select poses."""
        return Track(
            *(column[rows] for column in (self.times, self.quats, self.places, self.place_noise, self.turn_noise))
        )

    def with_model_error(self, first: int, size: float) -> Track:
        """The poses with the error of a simulation besides their noise, from the pose ``first`` on."""
        touched = np.arange(len(self)) >= first
        return dataclasses.replace(
            self,
            place_noise=np.hypot(self.place_noise, touched * _PLACE * size),
            turn_noise=np.hypot(self.turn_noise, touched * _TURN),
        )
