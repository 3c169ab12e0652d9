"""Breaks of a motion inside the observed window, as candidates that fit all poses together.

The pose is continuous at the break, and rates or laws change there. Both sides share parameters, so two poses after the
break suffice. Notation: c the time of the break, b = min(tau - c, 0), f = max(tau, c); rates without a prefix apply
after the break and are values at t_max, D rates are added before it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..motion import levenberg_marquardt, rotations, se3
from ..motion.models import Block
from ..motion.pose_track import PoseTrack
from . import candidates as families
from .candidates import Candidate, Noise, Solution

LEAST_AFTER = 2  # poses after a break
_BLOCKS = {
    "v": Block(3),
    "w": Block(3),
    "dv": Block(3, 100.0),
    "dw": Block(3, 100.0),
    "g": Block(3, 100.0),
    "a": Block(3, 100.0),
    "h": Block(3, 100.0),
    "c": Block(1, 3.0),
}
_STEPS = 9
_BEFORE, _AFTER = 4, 5  # poses of the first guess
Parts = dict[str, np.ndarray]


@dataclass(frozen=True)
class Break:
    """A kind of break.

    Attributes:
        event: "impact", "start", "stop" or "change".
        blocks: Free blocks beside r, e and c. v, w: after the break. dv, dw: jumps. g: acceleration on both sides.
            a: acceleration after the break alone. h: acceleration before it alone.
        law: Name of the candidate after the break.
    """

    event: str
    blocks: tuple[str, ...]
    law: str


BREAKS = {
    "start": Break("start", ("v", "w"), "translation + spin"),
    "stop": Break("stop", ("dv", "dw"), "static"),
    "drop": Break("start", ("a",), "translation, quadratic"),
    "throw": Break("start", ("v", "a", "w"), "ballistic + spin"),
    "land": Break("stop", ("dv", "dw", "h"), "static"),
    "switch": Break("change", ("v", "w", "a"), "ballistic + spin"),
    "impact": Break("impact", ("v", "w", "dv", "dw"), "translation + spin"),
    "impact in flight": Break("impact", ("v", "w", "dv", "dw", "g"), "ballistic + spin"),
}


@dataclass(frozen=True)
class Kink(Candidate):
    """A break between two neighbouring poses, or one such break per start if the limits are arrays [B, 1, 1, 1].

    Attributes:
        low, high: Times of the poses before and after the gap.
        gap: Index of the first pose after it.
    """

    low: np.ndarray | float = -1.0
    high: np.ndarray | float = 0.0
    gap: int = 0

    @property
    def broken(self) -> Break:
        """The kind of break."""
        return BREAKS[self.name]

    @property
    def placed(self) -> int:
        return 1

    @property
    def last_choice(self) -> int:
        return self.gap + LEAST_AFTER

    def _block(self, name: str) -> Block:
        return _BLOCKS[name] if name in _BLOCKS else super()._block(name)

    def time(self, parts: Parts) -> np.ndarray:
        """Time of the break, mapped into its gap by the logistic function. [..., 1]"""
        return self.low + (self.high - self.low) / (1 + np.exp(-np.clip(parts["c"], -4, 4)))

    def poses(self, theta: np.ndarray, tau: np.ndarray) -> se3.Pose:
        p = {name: part[..., None, :] for name, part in self.parts(theta).items()}
        t, c = tau[:, None], self.time(p)
        b, f = np.minimum(t - c, 0), np.maximum(t, c)
        rests = self.broken.event == "start"
        v, w = p.get("v", np.zeros(3)), p.get("w", np.zeros(3))
        if self.name == "drop":
            v = -p["a"] * c
        d = p["e"] + v * (f if rests else t)
        for name, way in (("dv", b), ("g", 0.5 * t**2), ("h", 0.5 * b**2)):
            if name in p:
                d = d + p[name] * way
        if "a" in p:
            d = d + p["a"] * (0.5 * f**2 + (0 if rests else c * b))
        quats = rotations.rotvecs_to_quats(p["r"])
        if "w" in p:
            quats = rotations.multiply(rotations.rotvecs_to_quats(w * f), quats)
        if "dw" in p:
            quats = rotations.multiply(rotations.rotvecs_to_quats((w + p["dw"]) * b), quats)
        elif "w" in p and not rests:
            quats = rotations.multiply(rotations.rotvecs_to_quats(w * b), quats)
        shape = np.broadcast_shapes(quats.shape[:-1], d.shape[:-1])
        return np.broadcast_to(quats, (*shape, 4)), d

    def jump(self, theta: np.ndarray) -> float:
        """Change of the rates by the break until t_max, relative to the largest rates on either side. [P]"""
        if self.broken.event in ("start", "stop"):
            return 1.0
        p = self.parts(theta)
        left, none = -float(self.time(p)[0]), np.zeros(3)
        change = p.get("dv", none) - left * p.get("a", none), p.get("dw", none)
        after = p["v"], p["w"]
        before = [x + dx for x, dx in zip(after, change, strict=True)]
        sizes = [float(np.linalg.norm(np.concatenate(rates))) for rates in (change, after, before)]
        return sizes[0] / max(*sizes[1:], 1e-12)

    @property
    def law(self) -> Candidate:
        return replace(families.BY_NAME[self.broken.law], window=self.window)

    def law_parameters(self, theta: np.ndarray) -> np.ndarray:
        p = self.parts(theta)
        c = self.time(p)
        after = {"r": p["r"], "e": p["e"], "w": p.get("w"), "a": p.get("a", p.get("g"))}
        after["v"] = -p["a"] * c if self.name == "drop" else p.get("v")
        return np.concatenate([after[name] for name in ("r", "e", *self.law.blocks)], -1)

    def events(self, theta: np.ndarray) -> list[tuple[str, np.ndarray]]:
        return [(self.broken.event, self.time(self.parts(theta)))]


def search(track: PoseTrack, noise: Noise, hopeless: float = np.inf, first_gap: int = 2) -> list[Solution]:
    """Fit all kinds of breaks in all gaps; the best gap of each kind.

    Args:
        track: The poses.
        noise: Their noise.
        hopeless: See `candidates.solve`.
        first_gap: Minimum number of poses before a break.
    """
    gaps = np.arange(first_gap, len(track) - LEAST_AFTER + 1)
    if len(gaps) == 0 or len(track) < 5:
        return []
    sides = _Sides(track, gaps)
    found = []
    for name, kind in BREAKS.items():
        low, high = track.tau[gaps - 1], track.tau[gaps]
        kink = Kink(name, "ballistic_spin", (*kind.blocks, "c"), track.window)
        if kink.parameters > 6 * len(track) - 12:
            continue
        starts = np.array([kink.pack(sides.guess(name, k)) for k in range(len(gaps))])
        solved = levenberg_marquardt.solve_all(
            _residuals(kink, low, high, track, noise),
            starts,
            weights=track.weights,
            precision=kink.precision,
            softness=families.SOFTNESS,
            steps=_STEPS,
            enough=0.05,
            hopeless=hopeless,
            behind=families.HOPELESS_LOSS,
        )
        cost = np.where(np.isfinite(solved.cost) & np.isfinite(solved.normal).all((1, 2)), solved.cost, np.inf)
        best = int(np.argmin(cost))
        if np.isfinite(cost[best]):
            kink = replace(kink, low=float(low[best]), high=float(high[best]), gap=int(gaps[best]))
            found.append(families.solution(kink, solved.row(best), track))
    return found


def _residuals(
    kink: Kink, low: np.ndarray, high: np.ndarray, track: PoseTrack, noise: Noise
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    def residuals(theta: np.ndarray, rows: np.ndarray) -> np.ndarray:
        here = replace(kink, low=low[rows, None, None, None], high=high[rows, None, None, None])
        return families.residuals(here, theta, track, noise)

    return residuals


class _Sides:
    """First guesses from lines through the poses before and after each gap."""

    def __init__(self, track: PoseTrack, gaps: np.ndarray):
        self._track, self._gaps = track, gaps

    @functools.cached_property
    def _lines(self) -> list[tuple[np.ndarray, ...]]:
        found = []
        for gap in self._gaps:
            before = self._line(max(0, gap - _BEFORE), gap)
            found.append((*before, *self._line(gap, min(len(self._track), gap + _AFTER))))
        return found

    def _line(self, start: int, stop: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position at t_max, velocity and spin of some poses."""
        tau, places = self._track.tau[start:stop], self._track.displacements[start:stop]
        middle, mean = tau.mean(), places.mean(0)
        v = (tau - middle) @ (places - mean) / max(float(((tau - middle) ** 2).sum()), 1e-12)
        turned = self._track.turned
        return mean - v * middle, v, (turned[stop - 1] - turned[start]) / max(float(tau[-1] - tau[0]), 1e-12)

    def guess(self, name: str, k: int) -> Parts:
        """First guess of a kind of break in gap ``k``."""
        track, gap = self._track, int(self._gaps[k])
        _, v1, w1, e2, v2, w2 = self._lines[k]
        tau, c = track.tau, 0.5 * (track.tau[gap - 1] + track.tau[gap])
        kind = BREAKS[name]
        guess = {"e": e2, "v": v2, "w": w2, "dv": v1 - v2, "dw": w1 - w2, "c": np.zeros(1)}
        columns = {"start": np.maximum(tau, c), "stop": np.ones_like(tau)}.get(kind.event, tau)
        b, f = np.minimum(tau - c, 0), np.maximum(tau, c)
        ways = {"g": 0.5 * tau**2, "a": 0.5 * f**2 + (0 if kind.event == "start" else c * b), "h": 0.5 * b**2}
        bent = next((block for block in ways if block in kind.blocks), None)
        if bent is not None:
            way = 0.5 * np.maximum(tau - c, 0) ** 2 if name == "drop" else ways[bent]
            first = [np.ones_like(tau)] + ([columns] if "v" in kind.blocks else [])
            jump = [b] if "dv" in kind.blocks else []
            fit = np.linalg.lstsq(np.stack([*first, *jump, way], -1), track.displacements, rcond=None)[0]
            guess["e"], guess[bent] = fit[0], fit[-1]
            if "v" in kind.blocks:
                guess["v"] = fit[1]
            if jump:
                guess["dv"] = fit[-2]
            if name == "switch":
                guess["w"] = track.spin
            if name == "drop":
                guess["e"] = fit[0] + fit[-1] * 0.5 * c**2
        if kind.event == "stop":
            mean = rotations.normalize(track.quats[gap:].mean(0))
            guess |= {"r": rotations.quats_to_rotvecs(mean), "dw": w1}
            guess |= {} if bent else {"e": track.displacements[gap:].mean(0), "dv": v1}
        elif "w" in kind.blocks:
            back = rotations.rotvecs_to_quats(-guess["w"] * tau[gap])
            guess["r"] = rotations.quats_to_rotvecs(rotations.multiply(back, track.quats[gap]))
        else:
            guess["r"] = rotations.quats_to_rotvecs(rotations.normalize(track.quats.mean(0)))
        return guess
