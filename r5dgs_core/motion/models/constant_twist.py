"""A screw: constant rotation and translation in the body's own axes."""

from __future__ import annotations

import numpy as np

from .. import rotations, se3
from .base import Curve, Rates
from .twist import Twist


class ConstantTwist(Twist):
    """R_f = exp(w tau), d_f = V(w tau) v tau."""

    label = "Screw"
    tooltip = "Turns at a constant rate and moves along its own axes"
    word = "screw"
    fields = ("velocity", "angular_velocity")
    fits = {"constant twist": ("v", "w")}
    drawn_fits = (("velocity", "angular_velocity"),)

    def poses(self, rates: Rates, span: np.ndarray) -> se3.Pose:
        turn = rates.w * span
        return rotations.rotvecs_to_quats(turn), se3.v_matrix_times(turn, rates.v + 0 * turn) * span

    def motion(self, rates: Rates, span: np.ndarray) -> Curve:
        quats, d = self.poses(rates, span)
        zero = 0 * span
        return quats, d, rates.w + zero, rotations.rotate(quats, rates.v + zero)


KIND = ConstantTwist()
