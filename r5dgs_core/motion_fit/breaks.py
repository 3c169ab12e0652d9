"""Breaks of a motion inside the observed window, as candidates that fit all poses together.

The pose is continuous at the break, and rates or laws change there. Both sides share parameters, so two poses after the
break suffice. Notation: c the time of the break, b = min(tau - c, 0), f = max(tau, c); rates without a prefix apply
after the break and are values at t_max, D rates are added before it.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

from ..motion import levenberg_marquardt, rotations, se3
from ..motion.models import Block
from ..motion.pose_track import PoseTrack
from . import break_fits
from . import candidates as families
from .candidates import Candidate, FittedCandidate, Noise

MIN_POSES_AFTER = 2  # minimum number of poses after a break
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
_PRECISION = np.repeat([0.0, 0.0, *(1 / block.prior for block in _BLOCKS.values())], 3)[: break_fits.COUNT]
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

    @property
    def rests_before(self) -> bool:
        """True if the body is at rest before the break."""
        return self.event == "start"

    @property
    def rests_after(self) -> bool:
        """True if the body is at rest after the break."""
        return self.event == "stop"

    @property
    def starts_slowly(self) -> bool:
        """True if the velocity is zero at the break."""
        return self.rests_before and "v" not in self.blocks

    @property
    def keeps_spin(self) -> bool:
        """True if the spin is the same on both sides."""
        return "w" in self.blocks and "dw" not in self.blocks and not self.rests_before

    @property
    def bend(self) -> str | None:
        """Block of the acceleration, or None."""
        return next((block for block in "gah" if block in self.blocks), None)

    def ways(self, t: np.ndarray, c: np.ndarray) -> dict[str, np.ndarray]:
        """Factors of the blocks in the displacement, at times t of a break at c; [...] each."""
        b, f = np.minimum(t - c, 0), np.maximum(t, c)
        way = 0.5 * f**2 - c * f if self.starts_slowly else 0.5 * f**2 + (0 if self.rests_before else c * b)
        found = {"v": f if self.rests_before else t, "dv": b, "g": 0.5 * t**2, "h": 0.5 * b**2, "a": way}
        return {name: factor for name, factor in found.items() if name in self.blocks}


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
class BreakCandidate(Candidate):
    """A break between two neighbouring poses.

    Attributes:
        low, high: Times of the poses before and after the gap.
        gap: Index of the first pose after it.
    """

    low: float = -1.0
    high: float = 0.0
    gap: int = 0

    @property
    def broken(self) -> Break:
        """The kind of break."""
        return BREAKS[self.name]

    @property
    def discrete_choices(self) -> int:
        return 1

    @property
    def poses_with_choices(self) -> int:
        return self.gap + MIN_POSES_AFTER

    def _block(self, name: str) -> Block:
        return _BLOCKS[name] if name in _BLOCKS else super()._block(name)

    def time(self, parts: Parts) -> np.ndarray:
        """Time of the break, mapped into its gap by the logistic function. [..., 1]"""
        return self.low + (self.high - self.low) / (1 + np.exp(-np.clip(parts["c"], -4, 4)))

    def poses(self, theta: np.ndarray, tau: np.ndarray) -> se3.Pose:
        p = {name: part[..., None, :] for name, part in self.parts(theta).items()}
        t, c = tau[:, None], self.time(p)
        b, f = np.minimum(t - c, 0), np.maximum(t, c)
        d = p["e"]
        for name, way in self.broken.ways(t, c).items():
            d = d + p[name] * way
        quats = rotations.rotvecs_to_quats(p["r"])
        if "w" in p:
            quats = rotations.multiply(rotations.rotvecs_to_quats(p["w"] * f), quats)
        before = self._spin_before(p)
        if before is not None:
            quats = rotations.multiply(rotations.rotvecs_to_quats(before * b), quats)
        shape = np.broadcast_shapes(quats.shape[:-1], d.shape[:-1])
        return np.broadcast_to(quats, (*shape, 4)), d

    def _spin_before(self, parts: Parts) -> np.ndarray | None:
        """Spin before the break, or None if the body does not spin there."""
        if "dw" in parts:
            return parts.get("w", np.zeros(3)) + parts["dw"]
        return None if self.broken.rests_before else parts.get("w")

    def jump(self, theta: np.ndarray) -> float:
        """Change of the rates by the break until t_max, relative to the largest rates on either side. [P]"""
        if self.broken.rests_before or self.broken.rests_after:
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
        after["v"] = -p["a"] * c if self.broken.starts_slowly else p.get("v")
        return np.concatenate([after[name] for name in ("r", "e", *self.law.blocks)], -1)

    def events(self, theta: np.ndarray) -> list[tuple[str, np.ndarray]]:
        return [(self.broken.event, self.time(self.parts(theta)))]


def search(track: PoseTrack, noise: Noise, hopeless: float = np.inf, first_gap: int = 2) -> list[FittedCandidate]:
    """Fit all kinds of breaks in all gaps; the best gap of each kind.

    Args:
        track: The poses.
        noise: Their noise.
        hopeless: See `candidates.solve`.
        first_gap: Minimum number of poses before a break.
    """
    gaps = np.arange(first_gap, len(track) - MIN_POSES_AFTER + 1)
    if len(gaps) == 0 or len(track) < 5:
        return []
    sides, low, high = _Sides(track, gaps), track.tau[gaps - 1], track.tau[gaps]
    kinds = [(kind, _candidate(name, track)) for name, kind in BREAKS.items()]
    kinds = [(kind, family) for kind, family in kinds if family.parameters <= 6 * len(track) - 12]
    if not kinds:
        return []
    starts = np.zeros((len(kinds), len(gaps), break_fits.COUNT))
    for row, (kind, family) in enumerate(kinds):
        guesses = np.array([family.pack(sides.guess(kind, k)) for k in range(len(gaps))])
        starts[row][:, break_fits.rows_of(family)] = guesses
    every = break_fits.Breaks.of([(family, kind.rests_before, kind.starts_slowly) for kind, family in kinds], low, high)
    solved = levenberg_marquardt.solve_linearized(
        lambda theta, rows: every.linearized(theta, rows, track, noise),
        starts.reshape(-1, break_fits.COUNT),
        weights=track.weights,
        precision=_PRECISION,
        softness=families.SOFTNESS,
        steps=_STEPS,
        enough=0.05,
        hopeless=hopeless,
        behind=families.HOPELESS_LOSS,
    )
    finite = np.isfinite(solved.cost) & np.isfinite(solved.normal).all((1, 2))
    costs = np.where(finite, solved.cost, np.inf).reshape(len(kinds), -1)
    found = []
    for row, (_, family) in enumerate(kinds):
        best = int(np.argmin(costs[row]))
        if np.isfinite(costs[row, best]):
            chosen = replace(family, low=float(low[best]), high=float(high[best]), gap=int(gaps[best]))
            own = break_fits.rows_of(family)
            point = solved.row(row * len(gaps) + best)
            normal = point.normal[np.ix_(own, own)]
            found.append(FittedCandidate(chosen, point.x[own], normal, point.residuals, track.weights))
    return found


def _candidate(name: str, track: PoseTrack) -> BreakCandidate:
    return BreakCandidate(name, "ballistic_spin", (*BREAKS[name].blocks, "c"), track.window)


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
        turned = self._track.accumulated_rotation
        return mean - v * middle, v, (turned[stop - 1] - turned[start]) / max(float(tau[-1] - tau[0]), 1e-12)

    def guess(self, kind: Break, k: int) -> Parts:
        """First guess of a kind of break in gap ``k``."""
        track, gap = self._track, int(self._gaps[k])
        _, v1, w1, e2, v2, w2 = self._lines[k]
        tau, c = track.tau, 0.5 * (track.tau[gap - 1] + track.tau[gap])
        guess = {"e": e2, "v": v2, "w": w2, "dv": v1 - v2, "dw": w1 - w2, "c": np.zeros(1)}
        if kind.bend is not None:
            ways = kind.ways(tau, np.array(c))
            fitted = [name for name in ("v", "dv", kind.bend) if name in ways]
            columns = np.stack([np.ones_like(tau), *(ways[name] for name in fitted)], -1)
            found = np.linalg.lstsq(columns, track.displacements, rcond=None)[0]
            guess |= dict(zip(("e", *fitted), found, strict=True))
        if kind.keeps_spin:
            guess["w"] = track.spin
        if kind.rests_after:
            mean = rotations.normalize(track.quats[gap:].mean(0))
            guess |= {"r": rotations.quats_to_rotvecs(mean), "dw": w1}
            guess |= {} if kind.bend else {"e": track.displacements[gap:].mean(0), "dv": v1}
        elif "w" in kind.blocks:
            back = rotations.rotvecs_to_quats(-guess["w"] * tau[gap])
            guess["r"] = rotations.quats_to_rotvecs(rotations.multiply(back, track.quats[gap]))
        else:
            guess["r"] = rotations.quats_to_rotvecs(rotations.normalize(track.quats.mean(0)))
        return guess
