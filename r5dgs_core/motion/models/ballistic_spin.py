"""Spin about a centre that flies along a parabola; a hinge or a pendulum if the centre is fixed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import rotations, se3
from .base import Curve, MotionKind, MotionModel, Rates

_SPIN = ("velocity", "acceleration", "angular_velocity", "angular_acceleration")


class BallisticSpin(MotionKind):
    """R_f = exp(w s1 + eps s2), d_f = v s1 + a s2 + u - R_f u. A hinge has v = a = 0 and u on its axis."""

    label = "Throw and Spin"
    tooltip = "Spins about a center that flies; a hinge or a pendulum if the center is fixed"
    word = "throw+spin"
    fields = (*_SPIN, "frequency", "damping")
    fits = {
        "spin": ("w",),
        "spin, accelerating": ("w", "kappa"),
        "translation + spin": ("v", "w"),
        "hinge": ("w", "kappa", "u"),
        "pendulum": ("swing", "phase", "u", "pace"),
        "damped pendulum": ("swing", "phase", "u", "pace", "decay"),
        "ballistic + spin": ("v", "a", "w"),
        "ballistic + spin, accelerating": ("v", "a", "w", "kappa"),
        "ballistic + spin, free axis": ("v", "a", "w", "eps"),
        "ballistic + spin, free centre": ("v", "a", "w", "u"),
        "full, free centre": ("v", "a", "w", "eps", "u"),
    }
    plain_fits = ("translation + spin", "ballistic + spin")
    drawn_fits = (_SPIN, (*_SPIN, "center_offset"))

    def poses(self, rates: Rates, span: np.ndarray) -> se3.Pose:
        v, a, w, eps, u = rates[:5]
        once, twice = rates.time_factors(span)
        quats = rotations.rotvecs_to_quats(w * once + eps * twice)
        arm = rotations.rotate(quats, u + 0 * quats[..., 1:])
        return quats, v * once + a * twice + (u - arm)

    def motion(self, rates: Rates, span: np.ndarray) -> Curve:
        v, a, w, eps, u = rates[:5]
        quats, d = self.poses(rates, span)
        once, twice = rates.time_factors(span)
        slope, slope2 = rates.time_factor_rates(span)
        # R = exp(phi) has angular velocity V(phi) phi'.
        spins = se3.v_matrix_times(w * once + eps * twice, w * slope + eps * slope2)
        return quats, d, spins, v * slope + a * slope2 - rotations.cross(spins, rotations.rotate(quats, u + 0 * span))

    def center(self, model: MotionModel) -> np.ndarray:
        return model.center_offset

    def with_center(self, model: MotionModel, point: np.ndarray, old: np.ndarray) -> MotionModel:
        return replace(model, center_offset=point)


KIND = BallisticSpin()
