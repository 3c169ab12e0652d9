"""Motion along a parabola without rotation, or the oscillation of a mass on a spring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import rotations, se3
from .base import Curve, MotionKind, MotionModel, Rates


class Translation(MotionKind):
    """R_f = I, d_f = v s1 + a s2. A spring is centred at a / W^2."""

    label = "Slide"
    tooltip = "Moves without turning; with swings, it oscillates like a mass on a spring"
    word = "slide"
    fields = ("velocity", "acceleration", "frequency")
    fits = {"translation": ("v",), "translation, quadratic": ("v", "a"), "spring": ("v", "a", "pace")}
    drawn_fits = (("velocity", "acceleration"),)

    def poses(self, rates: Rates, span: np.ndarray) -> se3.Pose:
        once, twice = rates.clocks(span)
        d = rates.v * once + rates.a * twice
        return rotations.identity(*d.shape[:-1]), d

    def motion(self, rates: Rates, span: np.ndarray) -> Curve:
        quats, d = self.poses(rates, span)
        slope = np.cos(rates.frequency * span)  # derivative of s1; that of s2 is s1
        return quats, d, np.zeros(d.shape), rates.v * slope + rates.a * rates.clocks(span)[0]

    def spins(self, model: MotionModel) -> bool:
        return False

    def center(self, model: MotionModel) -> np.ndarray | None:
        return model.acceleration / model.frequency**2 if model.frequency > 0 else None

    def with_center(self, model: MotionModel, point: np.ndarray, old: np.ndarray) -> MotionModel:
        return replace(model, acceleration=model.frequency**2 * point)


KIND = Translation()
