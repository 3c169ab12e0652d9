"""Backtest of a motion law: predictions of the last observed poses from a fit to the earlier ones."""

from __future__ import annotations

import math

import numpy as np

from ..motion.pose_track import PoseTrack
from . import candidates as families
from .candidates import FittedCandidate, Noise

HELD_OUT = 0.2  # share of the last poses that are predicted
_MIN_POSES = 8  # minimum number of poses of a track for this test
_MAX_SQUARE = 600.0  # maximum squared prediction error, in variances


def relative_error(chosen: FittedCandidate, track: PoseTrack, noise: Noise, variance: float) -> float:
    """Mean squared error, relative to its expectation, of predictions by the law refitted to earlier poses.

    The expected squared error is the variance of the noise plus that of the refitted prediction, both in units of
    ``variance``. Returns 1 for short tracks.
    """
    count = len(track)
    if count < _MIN_POSES:
        return 1.0
    shares = []
    most = count - chosen.candidate.poses_with_choices  # maximum number of poses to leave out
    for held in sorted({1, max(3, math.ceil(HELD_OUT * count)), count // 3}):
        if chosen.parameters > 4 * (count - held) or held > most:
            continue
        earlier = families.solve(chosen.candidate, track.rows(slice(0, count - held)), noise, [chosen.theta], steps=8)
        if earlier is None:
            return _MAX_SQUARE
        later = track.rows(slice(count - held, None))
        late, slopes = families.linearized(chosen.candidate, earlier.theta, later, noise)
        expected = 6 + np.einsum("phc,pq,qhc->h", slopes, earlier.inverse, slopes)
        squares = np.minimum((late**2).sum(-1), _MAX_SQUARE * variance)
        shares.append(squares / np.maximum(expected, 6.0) / variance)
    return float(np.concatenate(shares).mean()) if shares else 1.0
