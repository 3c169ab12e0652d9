"""The sum of two oscillations with different frequencies, such as a Lissajous figure or a coupled pendulum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from .. import rotations, se3
from ..pose_track import PoseTrack, Window
from . import first_guesses
from .base import Block, Curve, MotionKind, MotionModel, Rates, time_factor_rates, time_factors

_SEEN = 0.9  # minimum number of observed periods


class TwoOscillations(MotionKind):
    """d_f = v s1 + a s2 + v2 s1' + a2 s2', R_f = exp(w s1 + eps s2 + w2 s1' + eps2 s2'), ' of the second frequency."""

    label = "Two Swings"
    tooltip = "Oscillates with two frequencies at once"
    word = "two swings"
    fields = (
        *("velocity", "acceleration", "angular_velocity", "angular_acceleration", "frequency"),
        *("second_velocity", "second_acceleration", "second_angular_velocity", "second_angular_acceleration"),
        "second_frequency",
    )
    fits = {
        "two oscillations": ("v", "a", "pace", "v2", "a2", "pace2"),
        "two oscillations, rocking": ("v", "a", "pace", "v2", "a2", "pace2", "w", "eps", "w2", "eps2"),
    }
    blocks = {"v2": Block(3, 100.0), "a2": Block(3, 1000.0), "w2": Block(3, 100.0), "eps2": Block(3, 1000.0)} | {
        "pace2": Block(1, 5.0)
    }

    frequency_blocks = ("pace", "pace2")

    def motion(self, rates: Rates, span: np.ndarray) -> Curve:
        once, twice = time_factors(rates.frequency, span)
        once2, twice2 = time_factors(rates.frequency2, span)
        slope, slope2 = (time_factor_rates(f, span, 0.0)[0] for f in (rates.frequency, rates.frequency2))
        phi = rates.w * once + rates.eps * twice + rates.w2 * once2 + rates.eps2 * twice2
        d = rates.v * once + rates.a * twice + rates.v2 * once2 + rates.a2 * twice2
        rate = rates.w * slope + rates.eps * once + rates.w2 * slope2 + rates.eps2 * once2
        velocity = rates.v * slope + rates.a * once + rates.v2 * slope2 + rates.a2 * once2
        return rotations.rotvecs_to_quats(phi), d, se3.v_matrix_times(phi, rate), velocity

    def rates(self, parts: Mapping[str, np.ndarray], window: Window) -> Rates:
        rest = {name: parts[name] for name in ("v2", "a2", "w2", "eps2") if name in parts}
        return super().rates(parts, window)._replace(frequency2=window.frequency(parts["pace2"]), **rest)

    def resolved(self, parts: Mapping[str, np.ndarray], window: Window, count: int) -> bool:
        """True if nearly a full period of each oscillation is observed: slower ones can imitate any curve."""
        slowest = _SEEN * 2 * np.pi / -window.first
        return all(float(window.frequency(parts[block])[0]) >= slowest for block in self.frequency_blocks)

    def starts(self, blocks: Sequence[str], track: PoseTrack, window: Window) -> list[first_guesses.Guess]:
        return first_guesses.two_oscillation_guesses(track, window, time_factors)

    def moves(self, model: MotionModel) -> bool:
        return super().moves(model) or bool(model.second_velocity.any() or model.second_acceleration.any())

    def spins(self, model: MotionModel) -> bool:
        second = model.second_angular_velocity.any() or model.second_angular_acceleration.any()
        return super().spins(model) or bool(second)


KIND = TwoOscillations()
