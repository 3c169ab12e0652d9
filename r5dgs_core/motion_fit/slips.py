"""Slipped rotations of a track, as candidates that fit all poses together.

A tracked rotation may slip into a neighbouring minimum of a periodic or faint texture. Some poses then deviate by one
constant turn in the body's frame, R = R_law exp(b), while their positions stay right. An impact is the opposite: it
keeps the pose and changes the rates. The law, without the turn, predicts the motion.

Notation: b the turn; a slip lies in the gap before pose j.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..motion import rotations, se3
from ..motion.models import Block
from ..motion.pose_track import PoseTrack
from . import candidates as families
from .candidates import Candidate, FittedCandidate, Noise

LAWS = ("static", "translation", "translation + spin", "hinge", "ballistic + spin", "drag")
_TRIED = 2  # number of the largest jumps that are tried
_NEAR = 5  # number of turn rates whose median is the expected one
_JUMP = 5.0  # minimum deviation from the expected turn, in standard deviations of a rotation per component
_TURN = Block(3)
_SUFFIX = ", slipped"


@dataclass(frozen=True)
class Slip(Candidate):
    """A law some of whose observed rotations are turned by the block "b".

    Attributes:
        start, stop: First turned pose, and the first one after it that is not.
        low, high: Times between which they lie; infinite at an end of the track.
    """

    start: int = 0
    stop: int = 0
    low: float = -np.inf
    high: float = np.inf

    @property
    def discrete_choices(self) -> int:
        return int(np.isfinite(self.low)) + int(np.isfinite(self.high))

    @property
    def poses_with_choices(self) -> int:
        return 1 + (self.stop if np.isfinite(self.high) else self.start)

    def slip(self, theta: np.ndarray) -> np.ndarray:
        return np.zeros(3) if np.isfinite(self.high) else theta[-3:]

    @property
    def slip_times(self) -> tuple[float, ...]:
        """Times of the slips, in the middle of their gaps."""
        return tuple(time for time in (self.low, self.high) if np.isfinite(time))

    @property
    def slipped(self) -> tuple[float, float] | None:
        return self.low, self.high

    @property
    def law(self) -> Candidate:
        own = {"name": self.name.removesuffix(_SUFFIX), "kind": self.kind, "blocks": self.blocks[:-1]}
        return Candidate(**own, window=self.window, inertia=self.inertia)

    def _block(self, name: str) -> Block:
        return _TURN if name == "b" else super()._block(name)

    def law_parameters(self, theta: np.ndarray) -> np.ndarray:
        return theta[..., :-3]

    def poses(self, theta: np.ndarray, tau: np.ndarray) -> se3.Pose:
        quats, d = self.law.poses(theta[..., :-3], tau)
        turned = ((tau > self.low) & (tau < self.high))[:, None]
        return rotations.multiply(quats, rotations.rotvecs_to_quats(turned * theta[..., None, -3:])), d


def search(track: PoseTrack, noise: Noise, hopeless: float = np.inf) -> list[FittedCandidate]:
    """Fit plain laws with a slip at the largest jumps of the rotation; the best slip of each law.

    Args:
        track: The poses.
        noise: Their noise.
        hopeless: See `candidates.solve`.
    """
    jumps = _jumps(track)
    sizes = np.linalg.norm(jumps, axis=-1)
    gaps = 1 + np.argsort(-sizes, kind="stable")[:_TRIED]
    gaps = gaps[sizes[gaps - 1] > _JUMP * noise.turn]
    if len(gaps) == 0 or len(track) < _NEAR:
        return []
    best: dict[str, FittedCandidate] = {}
    for start, stop in _blocks(gaps, len(track)):
        low, high = (_middle(track, gap) for gap in (start, stop))
        b = jumps[start - 1] if start > 0 else -jumps[stop - 1]
        quats = track.quats.copy()
        quats[start:stop] = rotations.multiply(quats[start:stop], rotations.rotvecs_to_quats(-b))
        upright = replace(track, quats=rotations.make_continuous(quats))
        for name in LAWS:
            law = replace(families.BY_NAME[name], window=track.window)
            slip = Slip(name + _SUFFIX, law.kind, (*law.blocks, "b"), track.window, None, start, stop, low, high)
            starts = [np.concatenate([theta, b]) for theta in law.starts(upright)]
            found = families.solve(slip, track, noise, starts, hopeless=hopeless) if starts else None
            if found is not None and (name not in best or found.loss < best[name].loss):
                best[name] = found
    return list(best.values())


def _jumps(track: PoseTrack) -> np.ndarray:
    """Turns between neighbours beyond those expected from the rates nearby, in the body's frame. [S - 1, 3]"""
    steps = np.diff(track.tau)[:, None]
    count = len(track.spins)
    firsts = np.clip(np.arange(count) - _NEAR // 2, 0, max(count - _NEAR, 0))
    expected = np.stack([np.median(track.spins[i : i + _NEAR], axis=0) for i in firsts]) * steps
    before = rotations.multiply(rotations.rotvecs_to_quats(expected), track.quats[:-1])
    return rotations.quats_to_rotvecs(rotations.multiply(rotations.conjugate(before), track.quats[1:]))


def _blocks(gaps: np.ndarray, count: int) -> list[tuple[int, int]]:
    """First and end of the turned poses: the shorter part before or after each gap, and the poses between two gaps."""
    found = [(0, int(gap)) if 2 * gap < count else (int(gap), count) for gap in gaps]
    if len(gaps) == 2 and 2 * abs(int(gaps[1]) - int(gaps[0])) < count:
        found.append((int(min(gaps)), int(max(gaps))))
    return found


def _middle(track: PoseTrack, gap: int) -> float:
    """Time in the middle of a gap, infinite outside the track."""
    if gap in (0, len(track)):
        return -np.inf if gap == 0 else np.inf
    return 0.5 * float(track.tau[gap - 1] + track.tau[gap])
