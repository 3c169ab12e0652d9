"""Rest and a straight line: predictions of a track that no law predicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..motion.pose_track import PoseTrack
from . import candidates as families
from .candidates import FittedCandidate, Noise

_RULES = {"static": 2, "translation + spin": 5}  # law -> number of the last poses that it is fitted to
_MIN_POSES = 8  # minimum number of poses to compare the rules


def better(track: PoseTrack, noise: Noise, chosen: FittedCandidate) -> FittedCandidate | None:
    """Fit the rule that would have predicted the later poses better than the chosen law.

    Rules and law predict the last sixth and the last third of the poses from the ones before. Returns None for short
    tracks, or if the law predicts these poses better than both rules.
    """
    if len(track) < _MIN_POSES:
        return None
    misses, of_law = dict.fromkeys(_RULES, 0.0), 0.0
    for held in (len(track) // 6, len(track) // 3):
        seen, later = track.rows(slice(0, len(track) - held)), track.rows(slice(len(track) - held, None))
        refitted = families.solve(chosen.candidate, seen, noise, [chosen.theta], steps=8)
        of_law += np.inf if refitted is None else _miss(refitted, later, noise)
        for name in _RULES:
            earlier = _fitted(name, seen, noise)
            if earlier is None:
                return None
            misses[name] += _miss(earlier, later, noise)
    best = min(misses, key=lambda name: misses[name])
    return _fitted(best, track, noise) if misses[best] < of_law else None


def _miss(fitted: FittedCandidate, later: PoseTrack, noise: Noise) -> float:
    """Mean squared error of the predicted poses, in units of the noise."""
    return float(np.mean(families.residuals(fitted.candidate, fitted.theta, later, noise) ** 2))


def _fitted(name: str, track: PoseTrack, noise: Noise) -> FittedCandidate | None:
    last = track.rows(slice(-_RULES[name], None))
    return families.solve(replace(families.BY_NAME[name], window=last.window), last, noise)
