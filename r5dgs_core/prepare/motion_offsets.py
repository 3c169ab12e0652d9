"""Offsets between the clocks of calibrated static cameras from something that moves in their common view.

At the right offset, its path in one camera lies on the epipolar lines of its path in the other. The distances of all
pairs of cameras are minimised together; leaving out one block of time at a time gives the uncertainty.

Notation: C cameras, P pairs, D trial offsets, F times.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from ..motion import rotations
from .clock import Offset, solve_pairs
from .motion_tracks import MotionTrack

SEARCH_S = 5.0  # largest offset
FINE = 0.02  # step of the second scan, frame intervals
_ROUNDS = 12  # of the minimisation
BLOCKS = 8  # of time, for the uncertainty
SCALE_PX = 4.0  # distance at which the loss bends, pixels of the full image
BIAS_PX = 8.0  # largest constant distance that is taken as an error of the calibration
LEAST_TIMES = 12
COVERED = 0.5  # least share of the times that must be compared at a trial offset
GAP = 1.6  # longest step that is interpolated, frame intervals


@dataclass(frozen=True, eq=False)
class _Pair:
    a: int
    b: int
    essential: np.ndarray  # x_b^T E x_a = 0. [3, 3]


def measure(
    tracks: Sequence[MotionTrack],
    T_cam_world: Sequence[np.ndarray],
    intervals: Sequence[float],
    search: float = SEARCH_S,
) -> list[Offset] | None:
    """Measure the offset of each camera's clock.

    Args:
        tracks: A moving region per camera.
        T_cam_world: World to camera of each camera. C arrays [4, 4]
        intervals: Time between two frames of each camera, seconds.
        search: Largest offset, seconds.

    Returns:
        One offset per camera as `clock.solve_pairs` returns them; None if motion does not determine any.
    """
    pairs = [
        _Pair(a, b, essential(T_cam_world[a], T_cam_world[b]))
        for a, b in itertools.combinations(range(len(tracks)), 2)
        if min(len(tracks[a].times), len(tracks[b].times)) >= LEAST_TIMES
    ]
    if not pairs:
        return None
    step = max(intervals)
    spans = [float(np.ptp(tracks[camera].times)) for pair in pairs for camera in (pair.a, pair.b)]
    reach = min(search, 0.5 * min(spans))
    wide = np.arange(-reach, reach + step / 8, step / 4)
    starts = []
    for pair in pairs:
        curve = _curve(_distances(pair, tracks, wide, step), None)
        best = int(np.argmin(curve))
        if np.isfinite(curve[best]):
            starts.append((pair.a, pair.b, float(wide[best]), step))
    coarse = solve_pairs(len(tracks), starts, "motion")
    if coarse is None:
        return None
    known = [one.sigma is not None for one in coarse]
    pairs = [pair for pair in pairs if known[pair.a] and known[pair.b]]
    first = known.index(True)
    guess = np.array([one.seconds for one in coarse])
    for resolution, reach in ((step / 4, 3.0), (FINE * step, 1.5)):
        guess = _Scan(pairs, tracks, guess, step, resolution, reach).lowest()
    last = _Scan(pairs, tracks, guess, step, FINE * step, 1.0)
    dropped = [last.lowest(block) for block in range(BLOCKS)]
    spread = np.sqrt((BLOCKS - 1) / BLOCKS * np.square(np.array(dropped) - np.mean(dropped, axis=0)).sum(0))
    floor = FINE * step
    return [
        Offset(float(value), 0.0 if k == first else float(max(sigma, floor)), "motion") if known[k] else coarse[k]
        for k, (value, sigma) in enumerate(zip(guess, spread, strict=True))
    ]


def misfit(
    tracks: Sequence[MotionTrack], T_cam_world: Sequence[np.ndarray], interval: float, offsets: np.ndarray
) -> float:
    """Return the mean loss of all pairs at given offsets [C]; NaN without a pair."""
    values = []
    for a, b in itertools.combinations(range(len(tracks)), 2):
        if min(len(tracks[a].times), len(tracks[b].times)) >= LEAST_TIMES:
            pair = _Pair(a, b, essential(T_cam_world[a], T_cam_world[b]))
            trial = np.array([offsets[b] - offsets[a]])
            values.append(_curve(_distances(pair, tracks, trial, interval), None)[0])
    return float(np.mean(values)) if values else float("nan")


class _Scan:
    """Losses of all pairs within ``reach`` intervals of given offsets.

    Args:
        pairs: The pairs.
        tracks: A moving region per camera.
        start: The offsets. [C]
        step: Interval between frames, seconds.
        resolution: Step of the trial offsets, seconds.
        reach: Largest change of an offset, intervals.
    """

    def __init__(
        self,
        pairs: Sequence[_Pair],
        tracks: Sequence[MotionTrack],
        start: np.ndarray,
        step: float,
        resolution: float,
        reach: float,
    ):
        self._pairs, self._start, self._resolution = pairs, start, resolution
        span = reach * step
        self._trials = np.arange(-2 * span, 2 * span + resolution / 2, resolution)
        self._grid = np.arange(-span, span + resolution / 2, resolution)
        self._distances = [
            _distances(pair, tracks, start[pair.b] - start[pair.a] + self._trials, step) for pair in pairs
        ]

    def lowest(self, leave: int | None = None) -> np.ndarray:
        """Minimise the loss by one camera at a time, without one block of the times. [C]"""
        curves = [_curve(distances, leave) for distances in self._distances]
        moved = np.zeros(len(self._start))
        for _ in range(_ROUNDS):
            before = moved.copy()
            for camera in range(min(pair.a for pair in self._pairs) + 1, len(moved)):
                total = np.zeros(len(self._grid))
                for pair, curve in zip(self._pairs, curves, strict=True):
                    if camera in (pair.a, pair.b):
                        at = self._grid - moved[pair.a] if camera == pair.b else moved[pair.b] - self._grid
                        total += np.interp(at, self._trials, np.where(np.isfinite(curve), curve, 1e3))
                if total.any():
                    moved[camera] = _lowest(self._grid, total)
            if np.abs(moved - before).max() < 0.1 * self._resolution:
                break
        return self._start + moved


def _lowest(grid: np.ndarray, values: np.ndarray) -> float:
    """Return the place of the minimum, refined by a parabola."""
    at = int(np.argmin(values))
    if not 0 < at < len(grid) - 1:
        return float(grid[at])
    left, middle, right = values[at - 1 : at + 2]
    bend = left - 2 * middle + right
    part = 0.5 * (left - right) / bend if bend > 1e-12 else 0.0
    return float(grid[at] + np.clip(part, -0.5, 0.5) * (grid[1] - grid[0]))


def _curve(distances: np.ndarray, leave: int | None) -> np.ndarray:
    """Mean loss at each trial offset, without one block of the times; inf if few times can be compared. [D]

    Args:
        distances: Distances in pixels, NaN if there is nothing to compare. [D, F]
    """
    if leave is not None:
        blocks = np.arange(distances.shape[1]) * BLOCKS // max(distances.shape[1], 1)
        distances = distances[:, blocks != leave]
    known = np.isfinite(distances)
    count = known.sum(1)
    enough = count >= max(COVERED * (count.max() if len(count) else 0), LEAST_TIMES / 2)
    losses = np.full(len(distances), np.inf)
    with np.errstate(invalid="ignore"):
        for row in np.flatnonzero(enough):
            one = distances[row, known[row]]
            one = one - np.clip(np.median(one), -BIAS_PX, BIAS_PX)
            losses[row] = np.log1p(np.square(one / SCALE_PX)).mean()
    return losses


def _distances(pair: _Pair, tracks: Sequence[MotionTrack], trials: np.ndarray, step: float) -> np.ndarray:
    """Signed distances from epipolar lines at each trial offset, pixels. [D, F]"""
    one, other = tracks[pair.a], tracks[pair.b]
    result = np.full((len(trials), len(one.times)), np.nan)
    spline = CubicSpline(other.times, other.points, axis=0)
    x = np.concatenate([one.points, np.ones((len(one.times), 1))], 1)
    lines = x @ pair.essential.T
    for k, trial in enumerate(trials):
        asked = one.times - trial
        after = np.clip(np.searchsorted(other.times, asked), 1, len(other.times) - 1)
        good = (asked >= other.times[0]) & (asked <= other.times[-1])
        good &= other.times[after] - other.times[after - 1] <= GAP * step
        y = np.concatenate([spline(asked[good]), np.ones((int(good.sum()), 1))], 1)
        back = y @ pair.essential
        value = (y * lines[good]).sum(1)
        here = value / np.maximum(np.linalg.norm(lines[good, :2], axis=1), 1e-12) / other.pixel
        there = value / np.maximum(np.linalg.norm(back[:, :2], axis=1), 1e-12) / one.pixel
        result[k, good] = 0.5 * (here + there)
    return result


def essential(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the essential matrix with x_other^T E x_one = 0 of world-to-camera transforms [4, 4]. [3, 3]"""
    relative = other @ np.linalg.inv(one)
    t = relative[:3, 3] / max(float(np.linalg.norm(relative[:3, 3])), 1e-12)
    return rotations.skew(t) @ relative[:3, :3]
