"""Motion along a parabola without rotation, or the oscillation of a mass on a spring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import rotations, se3
from .base import Curve, MotionKind, MotionModel, Rates


class Translation(MotionKind):
    """R_f = I, d_f = v s1 + a s2. A spring is centred at (a + 2 c v) / (W^2 + c^2)."""

    label = "Slide"
    tooltip = "Moves without turning; with swings, it oscillates like a mass on a spring"
    word = "slide"
    fields = ("velocity", "acceleration", "frequency", "damping")
    fits = {"translation": ("v",), "translation, quadratic": ("v", "a"), "spring": ("v", "a", "pace")} | {
        "damped spring": ("v", "a", "pace", "decay")
    }
    drawn_fits = (("velocity", "acceleration"),)

    def poses(self, rates: Rates, span: np.ndarray) -> se3.Pose:
        once, twice = rates.time_factors(span)
        d = rates.v * once + rates.a * twice
        return rotations.identity(*d.shape[:-1]), d

    def motion(self, rates: Rates, span: np.ndarray) -> Curve:
        quats, d = self.poses(rates, span)
        slope, slope2 = rates.time_factor_rates(span)
        return quats, d, np.zeros(d.shape), rates.v * slope + rates.a * slope2

    def spins(self, model: MotionModel) -> bool:
        return False

    def center(self, model: MotionModel) -> np.ndarray | None:
        if model.frequency == 0:
            return None
        if model.damping == 0:
            return model.acceleration / model.frequency**2
        return (model.acceleration + 2 * model.damping * model.velocity) / (model.frequency**2 + model.damping**2)

    def with_center(self, model: MotionModel, point: np.ndarray, old: np.ndarray) -> MotionModel:
        stiffness = model.frequency**2 + model.damping**2
        return replace(model, acceleration=stiffness * point - 2 * model.damping * model.velocity)


KIND = Translation()
