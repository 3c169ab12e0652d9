"""Knots of the tracks: times at which the poses of the objects are learned.

A pose is determined well if several cameras see the object at that time. Cameras that do not record at the same moments
therefore share knots. Views are still drawn at their own times, on the curve between the knots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...scene.sampling import spread
from ..refinement import rig
from ..train_views import TrainView

SAME_TIME = 0.1  # share of the cameras' median time step within which times are equal
SHARED_KNOT = 0.5  # the same, for times that few cameras share
ENOUGH_CAMERAS = 3  # number of cameras at a time that needs no others
ROUNDING = 1e-8  # more than that of times, 1e-9


@dataclass(frozen=True)
class _Moment:
    """Times that share a knot, and the cameras that see them."""

    times: tuple[float, ...]
    cameras: frozenset[int]


def of(views: Sequence[TrainView], limit: int = 128) -> np.ndarray:
    """Return the knots of the tracks: the distinct observed times.

    Times of slightly unsynchronised cameras, within a tenth of the cameras' median time step, are one time. A time at
    which fewer than `ENOUGH_CAMERAS` cameras record shares a knot with others within half of the step. Two times of
    one camera never share a knot. If more than ``limit`` knots remain, they are sampled evenly by index, so that they
    are as dense as the images. The first and the last observed time are always knots.
    """
    cameras: dict[float, set[int]] = {}
    for view, camera in zip(views, rig.of(views).lens_of, strict=True):
        cameras.setdefault(round(view.t, 9), set()).add(int(camera))
    every = sorted(cameras)
    steps = [np.diff([t for t in every if one in cameras[t]]) for one in set().union(*cameras.values())]
    step = float(np.median(np.concatenate(steps))) if any(map(len, steps)) else 0.0
    moments = [_Moment((t,), frozenset(cameras[t])) for t in every]
    moments = _joined(moments, SAME_TIME * step + ROUNDING)
    moments = _joined(moments, SHARED_KNOT * step - ROUNDING, ENOUGH_CAMERAS)
    inner = [float(np.mean(one.times)) for one in moments[1:-1]]
    return np.array(spread([every[0], *inner, every[-1]] if len(moments) > 1 else every[-1:], limit))


def _joined(moments: Sequence[_Moment], reach: float, enough: float = np.inf) -> list[_Moment]:
    """Join moments of different cameras with the previous ones within a reach, unless both have enough cameras."""
    found: list[_Moment] = []
    for one in moments:
        last = found[-1] if found else None
        if (
            last is None
            or one.times[-1] - last.times[0] > reach
            or last.cameras & one.cameras
            or min(len(last.cameras), len(one.cameras)) >= enough
        ):
            found.append(one)
        else:
            found[-1] = _Moment(last.times + one.times, last.cameras | one.cameras)
    return found
