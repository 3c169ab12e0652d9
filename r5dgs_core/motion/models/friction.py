"""A body that slides or rolls under constant friction until it rests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from .. import rotations, se3
from ..pose_track import PoseTrack, Window
from . import first_guesses
from .base import Block, Curve, MotionKind, MotionModel, Rates

_STOPS = (0.3, 0.5, 0.8, 1.1, 1.5, 2.5)  # tried times of the stop, in spans after the first pose


class Friction(MotionKind):
    """R_f = exp(w s), d_f = v s, s = u - u^2 / (2 T), u = min(tau, T), with the stop time T; T = 0 for no friction."""

    label = "Friction"
    tooltip = "Slides or rolls more and more slowly until it rests"
    word = "friction"
    fields = ("velocity", "angular_velocity", "stop_time")
    fits = {"slide, friction": ("v", "log_stop"), "slide + turn, friction": ("v", "w", "log_stop")}
    needs_support = True
    blocks = {"log_stop": Block(1, 2.0)}

    def motion(self, rates: Rates, span: np.ndarray) -> Curve:
        stop = np.where(rates.stop_time > 0, rates.stop_time, np.inf)
        within = np.minimum(span, stop)
        share = within / stop
        way = within * (1 - 0.5 * share)
        left = np.where(span < stop, 1 - share, 0.0)
        return rotations.rotvecs_to_quats(rates.w * way), rates.v * way, rates.w * left, rates.v * left

    def rates(self, parts: Mapping[str, np.ndarray], window: Window) -> Rates:
        """ "v" and "w" are values at the first pose; "log_stop" is the logarithm of the time from there to the stop."""
        length = np.exp(np.clip(parts["log_stop"], -4.0, 4.0))
        stop = np.maximum(window.first + length, 0.0)
        left = np.maximum(1 + window.first / length, 0.0)
        return Rates(v=parts["v"] * left, w=parts.get("w", np.zeros(3)) * left, stop_time=stop)

    def observed(
        self, parts: Mapping[str, np.ndarray], tau: np.ndarray, window: Window, inertia: np.ndarray | None
    ) -> se3.Pose:
        length = np.exp(np.clip(parts["log_stop"], -4.0, 4.0))

        def way(since: np.ndarray) -> np.ndarray:
            within = np.minimum(since, length)
            return within - 0.5 * within**2 / length

        s = way(tau[:, None] - window.first) - way(np.array([-window.first]))
        spin = parts.get("w", np.zeros(3)) * s
        quats = rotations.multiply(rotations.rotvecs_to_quats(spin), rotations.rotvecs_to_quats(parts["r"]))
        return quats, parts["e"] + parts["v"] * s

    def starts(self, blocks: Sequence[str], track: PoseTrack, window: Window) -> list[first_guesses.Guess]:
        if len(track) < 6:
            return []
        found = []
        since = track.tau - window.first
        for stop in _STOPS:
            within = np.minimum(since, stop)
            way = within - 0.5 * within**2 / stop
            columns = np.stack([np.ones(len(track)), way - way[-1]], -1)
            place = first_guesses.least_squares(columns, track.displacements, track.weights)
            spin = first_guesses.least_squares(columns, track.accumulated_rotation, track.weights)
            miss = ((columns @ place - track.displacements) ** 2).sum()
            miss += ((columns @ spin - track.accumulated_rotation) ** 2).sum() if "w" in blocks else 0.0
            guess = {"r": np.zeros(3), "e": place[0], "v": place[1], "w": spin[1]}
            found.append((float(miss), stop, guess | {"log_stop": np.log(np.array([stop]))}))
        return [guess for _, _, guess in sorted(found, key=lambda entry: entry[:2])[:2]]

    def events(self, parts: Mapping[str, np.ndarray], window: Window) -> list[tuple[str, np.ndarray]]:
        stop = window.first + np.exp(np.clip(parts["log_stop"], -4.0, 4.0))
        return [("stop", stop)] if stop.reshape(-1)[0] < 0 else []

    def kinks(self, model: MotionModel, end: float) -> np.ndarray:
        return np.array([model.stop_time] if 0 < model.stop_time <= end else [])

    def spins(self, model: MotionModel) -> bool:
        return bool(model.angular_velocity.any())


KIND = Friction()
