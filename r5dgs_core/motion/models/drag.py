"""A body that drag slows down: velocity and spin decay exponentially; under gravity it nears a terminal velocity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from .. import rotations
from ..pose_track import PoseTrack, Window
from . import first_guesses
from .base import LOGARITHMS, Block, Curve, MotionKind, Rates

_DECAYS = (0.5, 1.0, 2.0, 4.0, 8.0)  # tried decay rates, per span
_SERIES = 1e-2  # |c tau| below which the second integral is a series
_MAX_EXPONENT = 600.0


class Drag(MotionKind):
    """v' = a - c v, w' = -c w: R_f = exp(w s), d_f = v s + a (tau - s) / c, s = (1 - exp(-c tau)) / c."""

    label = "Drag"
    tooltip = "Slows down in air or water and nears a steady velocity"
    word = "drag"
    fields = ("velocity", "acceleration", "angular_velocity", "damping")
    fits = {"drag": ("v", "w", "log_c"), "fall with drag": ("v", "w", "log_c", "terminal")}
    plain_fits = ("drag",)
    blocks = {"log_c": Block(1, 2.0), "terminal": Block(3, 100.0)}

    def motion(self, rates: Rates, span: np.ndarray) -> Curve:
        exponent = np.minimum(-rates.damping * span, _MAX_EXPONENT)
        once, twice = span * _first(exponent), span**2 * _second(exponent)
        decay = np.exp(exponent)
        quats = rotations.rotvecs_to_quats(rates.w * once)
        return quats, rates.v * once + rates.a * twice, rates.w * decay, rates.v * decay + rates.a * once

    def rates(self, parts: Mapping[str, np.ndarray], window: Window) -> Rates:
        """Rates at t_max; "v", the velocity minus "terminal", and the spin "w" are values at mid-window."""
        c = np.exp(np.clip(parts["log_c"], *LOGARITHMS))
        decay = np.exp(np.minimum(c * window.middle, _MAX_EXPONENT))
        terminal = parts.get("terminal", np.zeros(1))
        return Rates(v=parts["v"] * decay + terminal, a=c * terminal, w=parts["w"] * decay, damping=c)

    def starts(self, blocks: Sequence[str], track: PoseTrack, window: Window) -> list[first_guesses.Guess]:
        if len(track) < 6:
            return []
        found = []
        tau, ones = track.tau, np.ones(len(track))
        for c in _DECAYS:
            way = (np.exp(c * window.middle) - np.exp(-c * (tau - window.middle))) / c
            turn = np.stack([ones, way], -1)
            columns = np.stack([ones, way, tau], -1) if "terminal" in blocks else turn
            place = first_guesses.least_squares(columns, track.displacements, track.weights)
            spin = first_guesses.least_squares(turn, track.accumulated_rotation, track.weights)
            miss = ((columns @ place - track.displacements) ** 2).sum()
            miss += ((turn @ spin - track.accumulated_rotation) ** 2).sum()
            guess = {"r": np.zeros(3), "e": place[0], "v": place[1], "w": spin[1], "terminal": place[-1]}
            found.append((float(miss), c, guess | {"log_c": np.log(np.array([c]))}))
        return [guess for _, _, guess in sorted(found, key=lambda entry: entry[:2])[:2]]


def _first(z: np.ndarray) -> np.ndarray:
    """(exp(z) - 1) / z, 1 at 0."""
    safe = np.where(z == 0, 1.0, z)
    return np.where(z == 0, 1.0, np.expm1(safe) / safe)


def _second(z: np.ndarray) -> np.ndarray:
    """(exp(z) - 1 - z) / z^2, 1/2 at 0."""
    small = np.abs(z) < _SERIES
    safe = np.where(small, 1.0, z)
    series = 0.5 + z / 6 + z**2 / 24 + z**3 / 120 + z**4 / 720 + z**5 / 5040
    return np.where(small, series, (np.expm1(safe) - safe) / safe**2)


KIND = Drag()
