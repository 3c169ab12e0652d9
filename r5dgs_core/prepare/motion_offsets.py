"""Offsets between the clocks of calibrated static cameras from what moves in their common view.

At the right offset, its path in one camera lies on the epipolar lines of its path in the other. The distances of all
pairs of cameras are minimised together; the differences between blocks of time give the uncertainty.

Notation: C cameras, D trial offsets, G changes of an offset, F times.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from ..scene import cameras
from .clock import Offset, solve_pairs
from .motion_tracks import MotionTrack

SEARCH_S = 5.0  # largest offset
FINE = 0.02  # step of the second scan, frame intervals
_ROUNDS = 12  # of the minimisation, over all cameras
BLOCKS = 8  # parts of the time, whose differences give the uncertainty
SCALE_PX = 4.0  # distance at which the loss bends, pixels of the full image
BIAS_PX = 8.0  # largest constant distance that is taken as an error of the calibration
LEAST_TIMES = 12  # fewest times at which a camera sees an object
DISTINCT = 2.0  # least loss one interval from a usable offset, relative to that at the offset
COVERED = 0.5  # least share of the times that must be compared at a trial offset
GAP = 1.6  # longest step that is interpolated, frame intervals


Tracks = Sequence[Mapping[int, MotionTrack]]  # by camera, then by object


@dataclass(frozen=True, eq=False)
class _Pair:
    """Paths of an object in cameras a and b, with x_b^T E x_a = 0."""

    a: int
    b: int
    one: MotionTrack
    other: MotionTrack
    essential: np.ndarray  # E. [3, 3]

    @property
    def span(self) -> float:
        return float(min(np.ptp(self.one.times), np.ptp(self.other.times)))


def measure(
    tracks: Tracks, T_cam_world: Sequence[np.ndarray], intervals: Sequence[float], search: float = SEARCH_S
) -> list[Offset] | None:
    """Measure the offset of each camera's clock.

    Args:
        tracks: The moving objects of each camera, by a key that is the same in all cameras.
        T_cam_world: World to camera of each camera. C arrays [4, 4]
        intervals: Time between two frames of each camera, seconds.
        search: Largest offset, seconds.

    Returns:
        One offset per camera as `clock.solve_pairs` returns them; None if motion does not determine any.
    """
    pairs = _pairs(tracks, T_cam_world)
    if not pairs:
        return None
    step = max(intervals)
    cameras = sorted({(pair.a, pair.b) for pair in pairs})
    together = [[pair for pair in pairs if (pair.a, pair.b) == both] for both in cameras]
    reach = min(search, *(0.5 * max(pair.span for pair in some) for some in together))
    wide = np.arange(-reach, reach + step / 8, step / 4)
    starts = []
    for (a, b), some in zip(cameras, together, strict=True):
        curve = sum((_curve(_distances(pair, wide, step)) for pair in some), np.zeros(len(wide)))
        best = int(np.argmin(curve))
        if np.isfinite(curve[best]):
            starts.append((a, b, float(wide[best]), step))
    coarse = solve_pairs(len(tracks), starts, "motion")
    if coarse is None:
        return None
    known = [one.sigma is not None for one in coarse]
    pairs = [pair for pair in pairs if known[pair.a] and known[pair.b]]
    first = known.index(True)
    guess = np.array([one.seconds for one in coarse])
    for resolution, reach in ((step / 4, 3.0), (FINE * step, 1.5)):
        guess = _Scan(pairs, guess, step, resolution, reach).lowest()
    spread = _spread(pairs, guess, step, first)
    last = _Scan(pairs, guess, step, step / 4, 1.0)
    found = [Offset(0.0, None, "none")] * len(guess)
    found[first] = Offset(0.0, 0.0, "motion")
    for k in range(first + 1, len(guess)):
        if known[k] and np.isfinite(spread[k]) and last.distinct(k):
            found[k] = Offset(float(guess[k]), float(max(spread[k], FINE * step)), "motion")
    return found if any(found[k].sigma is not None for k in range(first + 1, len(found))) else None


def _pairs(tracks: Tracks, T_cam_world: Sequence[np.ndarray]) -> list[_Pair]:
    """Return the pairs of cameras that show one object long enough."""
    pairs = []
    for a, b in itertools.combinations(range(len(tracks)), 2):
        matrix = cameras.essential(T_cam_world[a], T_cam_world[b])
        for key in sorted(tracks[a].keys() & tracks[b].keys()):
            one, other = tracks[a][key], tracks[b][key]
            if min(len(one.times), len(other.times)) >= LEAST_TIMES:
                pairs.append(_Pair(a, b, one, other, matrix))
    return pairs


def misfit(tracks: Tracks, T_cam_world: Sequence[np.ndarray], interval: float, offsets: np.ndarray) -> float:
    """Return the mean loss of all pairs at given offsets [C]; NaN without a pair."""
    values = []
    for pair in _pairs(tracks, T_cam_world):
        trial = np.array([offsets[pair.b] - offsets[pair.a]])
        values.append(_curve(_distances(pair, trial, interval))[0])
    return float(np.mean(values)) if values else float("nan")


class _Scan:
    """Losses of all pairs within ``reach`` intervals of given offsets.

    Args:
        pairs: The pairs.
        start: The offsets. [C]
        step: Interval between frames, seconds.
        resolution: Step of the trial offsets, seconds.
        reach: Largest change of an offset, intervals.
    """

    def __init__(
        self,
        pairs: Sequence[_Pair],
        start: np.ndarray,
        step: float,
        resolution: float,
        reach: float,
    ):
        self._pairs, self._start, self._resolution = pairs, start, resolution
        span = reach * step
        self._trials = np.arange(-2 * span, 2 * span + resolution / 2, resolution)
        self._grid = np.arange(-span, span + resolution / 2, resolution)
        self._curves = [_curve(_distances(pair, start[pair.b] - start[pair.a] + self._trials, step)) for pair in pairs]

    def lowest(self) -> np.ndarray:
        """Minimise the loss by one camera at a time. [C]"""
        moved = np.zeros(len(self._start))
        for _ in range(_ROUNDS):
            before = moved.copy()
            for camera in range(min(pair.a for pair in self._pairs) + 1, len(moved)):
                total = self._total(camera, moved)
                if total.any():
                    moved[camera] = _lowest(self._grid, total)
            if np.abs(moved - before).max() < 0.1 * self._resolution:
                break
        return self._start + moved

    def distinct(self, camera: int) -> bool:
        """True if the loss of a camera at both ends of the scan is clearly larger than at the given offsets."""
        total = self._total(camera, np.zeros(len(self._start)))
        return bool(min(total[0], total[-1]) > DISTINCT * total[len(total) // 2])

    def _total(self, camera: int, moved: np.ndarray) -> np.ndarray:
        """Return the loss of a camera's pairs at each change of its offset, the others moved. [G]"""
        total = np.zeros(len(self._grid))
        for pair, curve in zip(self._pairs, self._curves, strict=True):
            if camera in (pair.a, pair.b):
                at = self._grid - moved[pair.a] if camera == pair.b else moved[pair.b] - self._grid
                total += np.interp(at, self._trials, np.where(np.isfinite(curve), curve, 1e3))
        return total


def _lowest(grid: np.ndarray, values: np.ndarray) -> float:
    """Return the place of the minimum, refined by a parabola."""
    at = int(np.argmin(values))
    if not 0 < at < len(grid) - 1:
        return float(grid[at])
    left, middle, right = values[at - 1 : at + 2]
    bend = left - 2 * middle + right
    part = 0.5 * (left - right) / bend if bend > 1e-12 else 0.0
    return float(grid[at] + np.clip(part, -0.5, 0.5) * (grid[1] - grid[0]))


def _spread(pairs: Sequence[_Pair], offsets: np.ndarray, step: float, first: int) -> np.ndarray:
    """Return standard deviations of the offsets: 0 for the first camera, inf if motion does not determine one. [C]

    Distances in one block of the times may have common errors; those of different blocks are independent. Distances
    that are constant or grow steadily are no evidence, as an error of the calibration has the same effect.
    """
    count, h = len(offsets), 0.25 * step
    matrix, sums = np.zeros((count, count)), np.zeros((BLOCKS, count))
    start, end = min(pair.one.times[0] for pair in pairs), max(pair.one.times[-1] for pair in pairs)
    for pair in pairs:
        at = offsets[pair.b] - offsets[pair.a]
        before, here, after = _distances(pair, np.array([at - h, at, at + h]), step)
        good = np.isfinite(before + here + after)
        if good.sum() < LEAST_TIMES / 2:
            continue
        times, left, slope = pair.one.times[good], here[good], (after - before)[good] / (2 * h)
        root = 1 / np.sqrt(1 + np.square((left - np.median(left)) / SCALE_PX))
        common = np.linalg.qr(root[:, None] * np.stack([np.ones_like(times), times - times.mean()], 1))[0]
        left, slope = (one - common @ (common.T @ one) for one in (root * left, root * slope))
        pull = slope @ slope
        for i, j, sign in ((pair.a, pair.a, 1), (pair.b, pair.b, 1), (pair.a, pair.b, -1), (pair.b, pair.a, -1)):
            matrix[i, j] += sign * pull
        block = ((times - start) / max(end - start, 1e-9) * (BLOCKS - 1e-6)).astype(int)
        part = np.bincount(block, slope * left, BLOCKS)
        sums[:, pair.b] += part
        sums[:, pair.a] -= part
    others = [k for k in range(count) if k != first]
    inner, sums = matrix[np.ix_(others, others)], sums[:, others] - sums[:, others].mean(0)
    loose = np.diag(inner) <= 0
    inner[loose, loose] = 1.0
    spread = np.sqrt(np.square(sums @ np.linalg.pinv(inner, hermitian=True)).sum(0) * BLOCKS / (BLOCKS - 1))
    result = np.zeros(count)
    result[others] = np.where(loose, np.inf, spread)
    return result


def _curve(distances: np.ndarray) -> np.ndarray:
    """Mean loss at each trial offset; inf if few times can be compared. [D]

    Args:
        distances: Distances in pixels, NaN if there is nothing to compare. [D, F]
    """
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


def _distances(pair: _Pair, trials: np.ndarray, step: float) -> np.ndarray:
    """Signed distances from epipolar lines at each trial offset, pixels. [D, F]"""
    one, other = pair.one, pair.other
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
