"""Checks whether the motion that a law predicts is plausible."""

from __future__ import annotations

import math

import numpy as np

from ..motion import models, rotations
from ..motion.pose_track import PoseTrack
from .candidates import FittedCandidate

STEEP = 0.9  # cosine of the angle to the vertical above which a motion is vertical
_AHEAD = 1 / 3  # time past t_max, in spans, over which a law must be plausible
_RUNAWAY = 2.5  # distance in this time, relative to the largest observed, above which a law is not plausible


def rises(solution: FittedCandidate, up: np.ndarray | None) -> bool:
    """Return True if a body slows down on a vertical line, as if thrown upwards, so that it needs a support."""
    candidate = solution.candidate
    if up is None or not models.KINDS[candidate.kind].needs_support or "w" in candidate.blocks:
        return False
    v = candidate.parts(solution.theta)["v"]
    return bool(abs(v @ up) > STEEP * np.linalg.norm(v) * np.linalg.norm(up))


def leans(solution: FittedCandidate, up: np.ndarray | None) -> bool:
    """Return True if a body bounces off a floor that is not level."""
    candidate = solution.candidate.law
    if up is None or candidate.kind != "bounce":
        return False
    a = candidate.rates(solution.law_theta).a
    return bool(-a @ up < STEEP * np.linalg.norm(a) * np.linalg.norm(up))


def is_possible(solution: FittedCandidate, up: np.ndarray | None) -> bool:
    """Return True if gravity allows a motion: neither `rises` nor `leans`."""
    return not rises(solution, up) and not leans(solution, up)


def runs_away(solution: FittedCandidate, track: PoseTrack) -> bool:
    """Return True if the body would move or turn much further past t_max than in any equal observed time."""
    ends = np.searchsorted(track.tau, track.tau + _AHEAD)
    starts = np.flatnonzero(ends < len(track))
    if len(starts) == 0:
        return False
    ends, tau = ends[starts], track.tau
    ways = track.displacements[ends] - track.displacements[starts]
    turns = track.accumulated_rotation[ends] - track.accumulated_rotation[starts]
    seen = (ways**2).sum(-1) + 2 / 3 * (turns**2).sum(-1)
    most = float(np.max(np.sqrt(seen) * _AHEAD / (tau[ends] - tau[starts])))
    quats, d = solution.candidate.path(solution.theta, np.linspace(0.0, _AHEAD, 9))
    angle = float(rotations.angle_between(quats[1:], quats[:-1]).sum())
    return bool(math.hypot(float(np.linalg.norm(d[-1] - d[0])), angle * math.sqrt(2 / 3)) > _RUNAWAY * most)
