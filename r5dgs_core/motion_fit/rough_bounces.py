"""Bounces off a rough floor, as candidates that fit all poses together.

A rough floor changes the spin of a body, and its velocity along the floor, at each impact. These changes are free at
the last impact before t_max, or at the last two; other impacts change neither. The motion past t_max is that of the
law without them. Notation as in `candidates`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..motion import models, rotations, se3
from ..motion.models import Block
from ..motion.pose_track import PoseTrack
from . import candidates as families
from .candidates import Candidate, FittedCandidate, Noise

LAWS = ("bounces, level", "bounces")
CHANGES = {
    "new spin": ("dw",),
    "new spins": ("dw", "dw2"),
    "rough floor": ("dw", "dv"),
    "rough floor, twice": ("dw", "dw2", "dv", "dv2"),
}
"""Free changes: dw of the spin and dv of the velocity along the floor, backwards in time; at the last impact, and with
a 2 at the one before."""
_BLOCK = Block(3, 100.0)
_EXPLAINED = 1.5  # loss of a law, relative to that of noise, below which it explains the poses
_MIN_POSES_AFTER = 2  # minimum number of poses after the last impact


@dataclass(frozen=True)
class RoughBounces(Candidate):
    """Bounces whose spin changes at the last impacts.

    Attributes:
        base: Name of the law past t_max.
        impact: Index of the first pose after the last impact.
    """

    base: str = "bounces"
    impact: int = 0

    @property
    def discrete_choices(self) -> int:
        return 1

    @property
    def poses_with_choices(self) -> int:
        return self.impact + _MIN_POSES_AFTER

    @property
    def law(self) -> Candidate:
        return replace(families.BY_NAME[self.base], window=self.window)

    def _block(self, name: str) -> Block:
        return _BLOCK if name in CHANGES["rough floor, twice"] else super()._block(name)

    def law_parameters(self, theta: np.ndarray) -> np.ndarray:
        return theta[..., : self.law.parameters]

    def poses(self, theta: np.ndarray, tau: np.ndarray) -> se3.Pose:
        p = {name: part[..., None, :] for name, part in self.parts(theta).items()}
        t, none = tau[:, None], np.zeros(3)
        last, before = models.KINDS[self.kind].last_impacts(p, self.window)
        _, d = models.KINDS[self.kind].observed(p, tau, self.window, None)
        spans = np.maximum(t, last), np.clip(t, before, last) - last, np.minimum(t, before) - before
        spins = p["w"], p["w"] + p["dw"], p["w"] + p["dw"] + p.get("dw2", none)
        quats = rotations.rotvecs_to_quats(p["r"])
        for spin, span in zip(spins, spans, strict=True):
            quats = rotations.multiply(rotations.rotvecs_to_quats(spin * span), quats)
        up = -p["a"] / np.linalg.norm(p["a"], axis=-1, keepdims=True) if "a" in p else np.array(self.window.up)
        for name, span in (("dv", np.minimum(t - last, 0)), ("dv2", spans[2])):
            if name in p:
                d = d + (p[name] - (p[name] * up).sum(-1, keepdims=True) * up) * span
        return quats, d


def search(
    track: PoseTrack, noise: Noise, laws: Sequence[FittedCandidate], hopeless: float = np.inf
) -> list[FittedCandidate]:
    """Fit bounces off a rough floor, starting at those off a smooth floor; none if another law explains the poses.

    Args:
        track: The poses.
        noise: Their noise.
        laws: Fits of laws, among them those of `LAWS` if the track seems to bounce.
        hopeless: See `candidates.solve`.
    """
    smooth, found = [s for s in laws if s.candidate.name in LAWS], []
    others = (s for s in laws if s.candidate.name not in LAWS)
    if any(s.loss < _EXPLAINED * (s.residuals.size - s.parameters) for s in others):
        return []
    for solution in smooth:
        for name, blocks in CHANGES.items():
            law = solution.candidate
            own = RoughBounces(f"{law.name}, {name}", law.kind, (*law.blocks, *blocks), law.window, base=law.name)
            if own.parameters > 6 * len(track) - 12:
                continue
            fitted = families.solve(own, track, noise, _starts(own, solution, track), hopeless=hopeless)
            if fitted is not None and (kept := _with_impact(fitted, track)) is not None:
                found.append(kept)
    return found


def added(
    broken: Sequence[FittedCandidate], track: PoseTrack, noise: Noise, laws: Sequence[FittedCandidate]
) -> list[FittedCandidate]:
    """Return candidates with breaks, and the results of `search` if none of them is a bounce."""
    if any(isinstance(s.candidate, RoughBounces) for s in broken):
        return list(broken)
    return [*broken, *search(track, noise, laws)]


def _starts(own: RoughBounces, smooth: FittedCandidate, track: PoseTrack) -> list[np.ndarray]:
    """First guesses from a fit of the smooth floor and from its own first guesses, with the spins of each flight."""
    law, kind, found = smooth.candidate, models.KINDS[smooth.candidate.kind], []
    for theta in (smooth.theta, *law.starts(track)):
        parts = law.parts(theta)
        last, before = (float(time[0]) for time in kind.last_impacts(parts, law.window))
        after = int(np.searchsorted(track.tau, last))
        spins = [_spin(track, *span) for span in ((last, 0.0), (before, last), (-np.inf, before))]
        w = track.spin if spins[0] is None else spins[0]
        dw = np.zeros(3) if spins[1] is None else spins[1] - w
        dw2 = np.zeros(3) if spins[2] is None else spins[2] - w - dw
        after = min(after, len(track) - 1)
        back = rotations.rotvecs_to_quats(-w * track.tau[after])
        r = rotations.quats_to_rotvecs(rotations.multiply(back, track.quats[after]))
        guess = parts | dict.fromkeys(CHANGES["rough floor, twice"], np.zeros(3))
        found.append(own.pack(guess | {"r": r, "w": w, "dw": dw, "dw2": dw2}))
    return found


def _spin(track: PoseTrack, start: float, stop: float) -> np.ndarray | None:
    """Median spin between neighbouring poses of a span of time; None without such poses."""
    rows = (track.tau[:-1] >= start) & (track.tau[1:] <= stop)
    return np.median(track.spins[rows], axis=0) if rows.any() else None


def _with_impact(fitted: FittedCandidate, track: PoseTrack) -> FittedCandidate | None:
    """Solution with the index of its last impact; None without two impacts among the poses, which show the floor."""
    own = fitted.candidate
    assert isinstance(own, RoughBounces)
    kind, parts = models.KINDS[own.kind], own.parts(fitted.theta)
    last, before = (float(time[0]) for time in kind.last_impacts(parts, own.window))
    after = int(np.searchsorted(track.tau, last))
    seen = track.tau[0] < before and after <= len(track) - _MIN_POSES_AFTER
    if not (seen and kind.resolved(parts, own.window, len(track))):
        return None
    return replace(fitted, candidate=replace(own, impact=after))
