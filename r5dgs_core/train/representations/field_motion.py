"""Deformation field and TRD combined: states of Gaussians at any time, observed or extrapolated.

Notation: R moved Gaussians, T the horizon of the deformation field. Network times are scene times, shifted and scaled
so that the observed ones lie in [0, 1]; if they already do and fill at least a quarter of it, they are used unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from ...model import deformation
from ...model.trd import TRD, MotionState
from ...motion import point_dynamics, rotations


@dataclass(frozen=True)
class Clock:
    """Conversion of scene time to the networks' time: (t - origin) / scale."""

    origin: float
    scale: float

    @staticmethod
    def of(times: np.ndarray) -> Clock:
        """Return the clock of the observed times: the identity if they lie in [0, 1] and fill a quarter of it."""
        first, last = float(times[0]), float(times[-1])
        scale = point_dynamics.time_unit(first, last)
        return Clock(0.0 if scale == 1.0 else first, scale)

    def __call__(self, t: float | Tensor) -> float | Tensor:
        return (t - self.origin) / self.scale


class FieldMotion:
    """Deformation field and TRD with their common clock.

    Args:
        field: The deformation field.
        trd: The TRD network.
        clock: Conversion of scene time to network time.
        start: First observed scene time.
        horizon: Scene time T.
        step: Time step h of the TRD in training, scene time.
        chunk: Gaussians per forward pass.
    """

    def __init__(
        self,
        field: deformation.DeformationField,
        trd: TRD,
        clock: Clock,
        start: float,
        horizon: float,
        step: float,
        chunk: int,
    ):
        self.field = field
        self.trd = trd
        self.clock = clock
        self.start = start
        self.horizon = horizon
        self.step = step
        self.chunk = chunk

    def deltas(self, means: Tensor, t: float | Tensor) -> deformation.Deltas:
        """Evaluate the field at a scene time; a number is clamped to the horizon."""
        return self.field(means, self.clock(t if isinstance(t, Tensor) else min(t, self.horizon)), self.chunk)

    def state(self, positions: Tensor, t: float | Tensor) -> MotionState:
        """Evaluate the TRD at positions and a scene time, per unit of network time."""
        return self.trd(positions, self.clock(t), self.chunk)

    def carry(
        self, positions: Tensor, state: MotionState, duration: float | Tensor, step: float
    ) -> tuple[Tensor, Tensor]:
        """Return positions and rotations after a signed scene time, by TRACE's integrator. [R, 3], [R, 4]"""
        return point_dynamics.rk2(
            positions,
            state.equiv_velocity,
            state.angular_velocity,
            state.equiv_acceleration,
            state.angular_acceleration,
            duration / self.clock.scale,
            step / self.clock.scale,
        )

    def at(self, means: Tensor, t: float) -> deformation.Deltas:
        """Return the state of Gaussians at any time: by the field up to T, then by the TRD."""
        deltas = self.deltas(means, t)
        step = point_dynamics.TRACE_STEP * self.clock.scale
        return deltas if t <= self.horizon else self.through(means, self.horizon, t, step)

    def through(self, means: Tensor, start: float | Tensor, t: float | Tensor, step: float) -> deformation.Deltas:
        """Move Gaussians by the field to ``start`` and by the TRD from there to ``t``.

        The TRD starts at positions without gradient.
        """
        deltas = self.deltas(means, start)
        begin = (means + deltas.offsets).detach()
        end, turns = self.carry(begin, self.state(begin, start), t - start, step)
        quats = rotations.multiply(turns, deltas.quats)
        return deformation.Deltas(deltas.offsets + (end - begin), quats, deltas.log_scales)
