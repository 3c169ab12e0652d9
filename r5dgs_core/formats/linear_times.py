"""Times between which linear interpolation follows a rigid motion, for formats without curves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..motion import rotations

TOLERANCE = 1e-5  # error at the members of a group, as a fraction of the scene's extent
_MOST = 1 << 16  # times
_CHECKED = (0.25, 0.5, 0.75)  # fractions of an interval

Sampler = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # times [T] -> quats [T, 4], positions [T, 3]


def refine(sample: Sampler, times: np.ndarray, tolerance: float, reach: float) -> np.ndarray:
    """Add times until linear interpolation of position and rotation between them is accurate.

    Args:
        sample: The motion; its quaternions are unit wxyz.
        times: First times, increasing, with all those at which the velocity jumps. [T]
        tolerance: Largest error of a member.
        reach: Largest distance of a member from the position.

    Returns:
        Increasing times, at most about `_MOST`; the error is larger if these do not suffice.
    """
    todo = np.arange(len(times) - 1)  # intervals to check
    while len(todo) and len(times) < _MOST:
        starts, ends = times[todo], times[todo + 1]
        (q0, p0), (q1, p1) = sample(starts), sample(ends)
        error = np.zeros(len(todo))
        for share in _CHECKED:
            q, p = sample(starts + share * (ends - starts))
            near = np.where((q0 * q1).sum(-1, keepdims=True) < 0, -q1, q1)
            angles = rotations.angle_between(rotations.interpolate(q0, near, share), q)
            error = np.maximum(error, np.linalg.norm((1 - share) * p0 + share * p1 - p, axis=-1) + reach * angles)
        middles = (starts + ends) / 2
        split = (error > tolerance) & (middles > starts) & (middles < ends)
        times = np.sort(np.concatenate([times, middles[split]]))
        todo = np.flatnonzero(np.isin(times[:-1], starts[split]) | np.isin(times[:-1], middles[split]))
    return times
