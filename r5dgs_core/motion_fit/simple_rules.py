"""Rest and a straight line: predictions of a track that no law predicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..motion.pose_track import PoseTrack
from . import candidates as families
from .candidates import FittedCandidate, Noise

_RULES = {"static": 2, "translation + spin": 5}  # law -> number of the last poses that it is fitted to
_FEWEST = 8  # minimum number of poses to compare the rules


def better(track: PoseTrack, noise: Noise) -> FittedCandidate | None:
    """Fit the rule that would have predicted the later poses better, or None for short tracks.

    Both rules predict the last sixth and the last third of the poses from the ones before.
    """
    if len(track) < _FEWEST:
        return None
    misses = dict.fromkeys(_RULES, 0.0)
    for held in (len(track) // 6, len(track) // 3):
        later = track.rows(slice(len(track) - held, None))
        for name in _RULES:
            earlier = _fitted(name, track.rows(slice(0, len(track) - held)), noise)
            if earlier is None:
                return None
            misses[name] += float(np.mean(families.residuals(earlier.candidate, earlier.theta, later, noise) ** 2))
    return _fitted(min(misses, key=lambda name: misses[name]), track, noise)


def _fitted(name: str, track: PoseTrack, noise: Noise) -> FittedCandidate | None:
    last = track.rows(slice(-_RULES[name], None))
    return families.solve(replace(families.BY_NAME[name], window=last.window), last, noise)
