"""Detection of bodies that have come to rest at the end of their observed poses.

Notation as in `model_selection`: a track is dimensionless, lengths in radii of the body.
"""

from __future__ import annotations

import numpy as np

from ..motion import rotations
from . import candidates as families
from .candidates import Solution, Track

STATIC = families.BY_NAME["static"]
TAIL = 5
SIGMA_FLOOR = 1e-7  # radii and radians; below this, noise is only rounding
STOP_RATIO = 8.0  # smallest ratio of the distance of the poses before a stop to the scatter of the poses after it
STOP_MOTION = 0.02  # radii; least motion before a stop


def poses_at_rest(picked: Solution, track: Track, sigmas: tuple[float, float]) -> int:
    """Number of final poses at which the body rests, or 0 if it is still moving.

    Args:
        picked: Motion selected without the rest test.
        track: The poses.
        sigmas: Noise of displacements (radii) and rotations (rad).
    """
    return TAIL if rests(picked, track, sigmas) else stopped(track)


def _tail_chi2(values: np.ndarray, parameters: int) -> float:
    return float((values**2).sum()) / max(values.size - parameters, 1)


def rests(picked: Solution, track: Track, sigmas: tuple[float, float]) -> bool:
    """Return True if a constant pose explains the last poses and the selected motion misfits the whole window.

    Without the second condition, slow bodies would count as resting.
    """
    if picked.candidate.name == "static" or len(track.tau) < 2 * TAIL:
        return False
    tail = track.rows(slice(-TAIL, None))
    still = families.residuals(STATIC, families.solve(STATIC, tail, sigmas).theta[None], tail, sigmas)[0]
    moving = families.residuals(picked.candidate, picked.theta[None], tail, sigmas)[0]
    still_chi2 = _tail_chi2(still, 6)
    moving_chi2 = max(_tail_chi2(moving, 0), 0.25)
    whole = families.residuals(picked.candidate, picked.theta[None], track, sigmas)[0]
    whole_chi2 = _tail_chi2(whole, picked.candidate.parameters)
    return still_chi2 <= 1.5 * moving_chi2 and whole_chi2 > 2 * max(still_chi2, 0.25)


def stopped(track: Track) -> int:
    """Number of final poses at which a body clearly stands still after moving, or 0.

    It does not use the noise estimate, because a stop within the window biases it. The last three to five poses must
    scatter little about their mean, and the two poses before must lie far from it relative to that scatter, the earlier
    one farther. The ratio is at most 2.4 for steady motion and 4.3 at the apex of a throw, so neither counts as a stop.
    """
    for count in (5, 4, 3):
        if len(track.tau) < count + 3:
            continue
        tail = track.rows(slice(-count, None))
        mean_quat = rotations.normalize(tail.quats.mean(0))
        mean = tail.displacements.mean(0)
        distance = _pose_distance(tail.quats, tail.displacements, mean_quat, mean)
        before = track.rows(slice(-count - 2, -count))
        earlier, just_before = _pose_distance(before.quats, before.displacements, mean_quat, mean)
        scatter = max(float(np.sqrt((distance**2).mean())), SIGMA_FLOOR)
        if just_before > max(STOP_RATIO * scatter, STOP_MOTION) and earlier > just_before:
            return count
    return 0


def _pose_distance(quats: np.ndarray, displacements: np.ndarray, mean_quat: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Root mean square distance of poses from one pose, over the points of a unit sphere. [S]"""
    angle = rotations.angle_between(quats, mean_quat)
    return np.sqrt(((displacements - mean) ** 2).sum(-1) + 2 / 3 * angle**2)
