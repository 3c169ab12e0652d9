"""Keyframe reduction: few keys of `cubic_curves` that reproduce a rigid motion within a tolerance.

Location and rotation have their own key times.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from . import cubic_curves, models, rotations

MAX_STEP_RAD = math.radians(120.0)
# per frame; near half a turn, the direction of rotation between two frames is ambiguous
MAX_FRAME_TURN_RAD = math.radians(160.0)
MIN_INTERVALS = 64  # first grid between two kinks
MAX_INTERVALS = 1 << 15
MIN_KINKS = 16  # lowest limit of the number of kinks
_BESIDE = 1e-7  # distance from a kink at which its slopes are sampled, as a fraction of the time between two kinks
_REST = 1e-3  # largest change of a curve that counts as constant, as a fraction of the tolerance
_FINER = 4  # checking grid points per candidate key time
_PER_FRAME = 4  # candidate key times
_STEPS_PER_SAMPLE, _STEPS_PER_INTERVAL = 4, 16  # integration steps
_ENOUGH_STEPS = 1 << 16  # cap on the minimum number of integration steps
_ONE_BY_ONE = 256  # keys found one by one; the rest is split into stripes that are searched together
_STEEPEST = 1e140  # limit of slopes in checks; squares of larger ones overflow, and such a curve fails anyway
_PER_STRIPE = 32  # keys per stripe; each stripe adds at most one

Samples = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
Sampler = Callable[[np.ndarray], Samples]


@dataclass(frozen=True)
class FrameTimes:
    """Times of an editor's frames: ``zero + k * duration`` for integers k."""

    zero: float
    duration: float


def model_sampler(model: models.MotionModel, t_max: float, most: int = MAX_INTERVALS) -> Sampler:
    """Return a sampler of a motion model at scene times >= t_max, for `reduce` with the same ``most``."""

    def sample(times: np.ndarray) -> Samples:
        steps = max(_STEPS_PER_SAMPLE * len(times), min(_STEPS_PER_INTERVAL * most, _ENOUGH_STEPS))
        quats, displacements, spins, velocities = models.evaluate_with_rates(
            model, np.maximum(times - t_max, 0.0), steps
        )
        return quats, displacements, rotations.quat_rates(quats, spins), velocities

    return sample


def reduce(
    sample: Sampler,
    t0: float,
    t1: float,
    tolerance: float,
    radius: float,
    kinks: Sequence[float] = (),
    nearest: float = 0.0,
    frames: FrameTimes | None = None,
    most: int = MAX_INTERVALS,
) -> cubic_curves.Curves:
    """Choose keys so that every point of the body stays within ``tolerance`` of the motion.

    The number of samples is bounded by a constant times ``most``; with ``frames``, also by a constant times the number
    of frames (and at least that of `MIN_INTERVALS`).

    Args:
        sample: Function of times [S] that gives quaternions [S, 4], displacements [S, 3] and their slopes per unit of
            time [S, 4], [S, 3]. It should be smooth between t0 and t1, except at the kinks.
        t0: First time.
        t1: Last time, > t0.
        tolerance: Maximum position error of any point, world units, > 0.
        radius: Largest distance of a point from the pivot, world units.
        kinks: Increasing times at which slopes jump. Those inside (t0, t1) get a key with the slopes of both sides,
            except those within ``nearest`` of the previous one or of an end, and those beyond the first
            max(`MIN_KINKS`, ``most`` / `MIN_INTERVALS`).
        nearest: Minimum time between candidate keys, for editors that merge closer keys.
        frames: Frames of the editor. A curve that four keys per frame do not reproduce, or a rotation of more than
            `MAX_FRAME_TURN_RAD` per frame, gets one key per frame.
        most: Maximum number of intervals between keys, >= `MIN_INTERVALS`. If there are more frames, a curve with
            one key per frame gets a key at every n-th frame.

    Returns:
        Location and rotation keys; one key for a curve that is constant within its share of the tolerance. The error
        |dd| + 2 radius sin(dtheta / 2) is checked on a grid four times finer than the candidate key times, which are
        doubled until single intervals are within the tolerance. No rotation step exceeds 120 degrees. A motion too fast
        for ``nearest``, ``frames`` or ``most`` gets as many keys as they allow, is exact at the keys, and has
        ``followed`` False.
    """
    if not (math.isfinite(t0) and math.isfinite(t1) and t1 > t0):
        raise ValueError(f"t0, t1: expected t0 < t1, got {t0} and {t1}")
    if not (tolerance > 0 and radius >= 0 and nearest >= 0 and most >= MIN_INTERVALS):
        raise ValueError(
            f"tolerance, radius, nearest, most: expected > 0, >= 0, >= 0 and >= {MIN_INTERVALS}, got {tolerance}, "
            f"{radius}, {nearest} and {most}"
        )
    bounds, most_kinks = [t0], max(MIN_KINKS, most // MIN_INTERVALS)
    for kink in kinks:
        if bounds[-1] + nearest < kink < t1 - nearest and len(bounds) <= most_kinks:
            bounds.append(float(kink))
    rest = tolerance if len(bounds) == 1 else _REST * tolerance
    limits = _Limits(tolerance, radius, rest, nearest, frames, most)
    pieces = [
        _smooth(_between(sample, a, b, a > t0, b < t1), a, b, limits) for a, b in itertools.pairwise([*bounds, t1])
    ]
    return functools.reduce(cubic_curves.join, pieces)


@dataclass(frozen=True)
class _Limits:
    """Arguments of `reduce`; ``rest`` is the largest error of a curve of one key."""

    tolerance: float
    radius: float
    rest: float
    nearest: float
    frames: FrameTimes | None
    most: int


def _between(sample: Sampler, start: float, stop: float, after_kink: bool, before_kink: bool) -> Sampler:
    """Sampler between two times, with one-sided slopes at kinks."""
    beside = _BESIDE * (stop - start)
    low, high = start + after_kink * beside, stop - before_kink * beside
    return (lambda times: sample(np.clip(times, low, high))) if after_kink or before_kink else sample


def _smooth(sample: Sampler, t0: float, t1: float, limits: _Limits) -> cubic_curves.Curves:
    """`reduce` between two kinks."""
    curves, followed = _sampled(sample, t0, t1, limits)
    every_frame = None
    if limits.frames is not None and not all(followed):
        every_frame = _at_frames(sample, t0, t1, limits.frames, limits.nearest, limits.most)
    keys = [
        framed if framed is not None and not holds else curve.greedy(np.arange(0, len(curve.times), _FINER))
        for curve, holds, framed in zip(curves, followed, every_frame or (None, None), strict=True)
    ]
    return cubic_curves.Curves(keys[0], keys[1], all(followed))


def _sampled(sample: Sampler, t0: float, t1: float, limits: _Limits) -> tuple[tuple[_Curve, _Curve], tuple[bool, bool]]:
    """Sample on finer grids until single intervals are within the tolerance, or the limits of `reduce` are met.

    Returns:
        Location and rotation; for each, True if single intervals follow it.
    """
    nearest, frames, limit = limits.nearest, limits.frames, limits.most
    intervals = min(MIN_INTERVALS, max(1, int((t1 - t0) / nearest))) if nearest > 0 else MIN_INTERVALS
    if frames is not None:
        limit = int(min(limit, max(MIN_INTERVALS, _PER_FRAME * (t1 - t0) / frames.duration)))
    while True:
        grid = np.linspace(t0, t1, intervals * _FINER + 1)
        location, rotation = _Curve.pair(sample(grid), grid, limits)
        possible = np.arange(0, len(grid), _FINER)
        too_fast = frames is not None and rotation.turn(min(frames.duration, t1 - t0)) > MAX_FRAME_TURN_RAD
        followed = location.steps_within_tolerance(possible), not too_fast and rotation.steps_within_tolerance(possible)
        settled = followed[0] and (followed[1] or too_fast)
        if settled or 2 * intervals > limit or t1 - t0 < 2 * intervals * nearest:
            return (location, rotation), followed
        intervals *= 2


def _at_frames(
    sample: Sampler, t0: float, t1: float, frames: FrameTimes, nearest: float, most: int
) -> tuple[cubic_curves.Keys, cubic_curves.Keys]:
    """Location and rotation keys at t0, t1 and the frames between them, or every n-th frame if more than ``most``."""
    first, last = math.ceil((t0 - frames.zero) / frames.duration), math.floor((t1 - frames.zero) / frames.duration)
    stride = 1 + max(last - first, 0) // most
    inside = frames.zero + frames.duration * np.arange(first, last + 1, stride, dtype=np.float64)
    apart = max(nearest, 1e-6 * frames.duration)
    times = np.concatenate([[t0], inside[(inside > t0 + apart) & (inside < t1 - apart)], [t1]])
    quats, displacements, _, _ = sample(times)
    curves = []
    for values in (displacements, rotations.make_continuous(np.asarray(quats, np.float64))):
        between = cubic_curves.slopes(times, values)
        curves.append(cubic_curves.Keys(times, values, between, between))
    return curves[0], curves[1]


class _Curve:
    """Samples of one curve on the checking grid, with its tolerance."""

    def __init__(self, times: np.ndarray, values: np.ndarray, slopes: np.ndarray, radius: float | None):
        self.times, self.values, self.slopes, self.radius = times, values, slopes, radius
        self._bounded_slopes = np.clip(slopes, -_STEEPEST, _STEEPEST)
        self.tolerance, self.constant = 0.0, False
        self.change = float(self.error(self.values[:1], self.values).max())

    @staticmethod
    def pair(samples: Samples, times: np.ndarray, limits: _Limits) -> tuple[_Curve, _Curve]:
        """Location and rotation curves. Each gets half the tolerance, or all of it if the other is constant."""
        quats, displacements, quat_slopes, displacement_slopes = (np.asarray(x, np.float64) for x in samples)
        signs = np.where((rotations.make_continuous(quats) * quats).sum(-1) < 0, -1.0, 1.0)[:, None]
        location = _Curve(times, displacements, displacement_slopes, None)
        rotation = _Curve(times, quats * signs, quat_slopes * signs, limits.radius)
        for curve, other in ((location, rotation), (rotation, location)):
            curve.tolerance = (1.0 if other.change <= _REST * limits.tolerance else 0.5) * limits.tolerance
            curve.constant = curve.change <= min(curve.tolerance, limits.rest)
        return location, rotation

    def error(self, values: np.ndarray, truth: np.ndarray) -> np.ndarray:
        """Largest position error of a point. [..., C] -> [...]"""
        if self.radius is None:
            return np.linalg.norm(values - truth, axis=-1)
        angle = rotations.angle_between(rotations.normalize(values), truth)
        return 2 * self.radius * np.sin(0.5 * angle)

    def turn(self, duration: float) -> float:
        """Upper bound of the rotation angle within a duration, from the sampled rates; rad."""
        return 2.0 * duration * float(np.linalg.norm(self._bounded_slopes, axis=-1).max())

    def steps_within_tolerance(self, possible: np.ndarray) -> bool:
        """Return True if every single interval between candidate key times is within the tolerance."""
        inside = possible[:-1, None] + np.arange(1, _FINER)
        return self.constant or bool(self._segments_hold(possible[:-1], possible[1:], inside).all())

    def _segments_hold(self, start: np.ndarray, stop: np.ndarray, inside: np.ndarray) -> np.ndarray:
        h = (self.times[stop] - self.times[start])[:, None, None]
        u = (self.times[inside] - self.times[start][:, None])[..., None] / h
        left, right = self.values[start][:, None], self.values[stop][:, None]
        left_slopes, right_slopes = self._bounded_slopes[start][:, None], self._bounded_slopes[stop][:, None]
        cubic = cubic_curves.hermite(left, right, left_slopes, right_slopes, h, u)
        good = np.all(self.error(cubic, self.values[inside]) <= self.tolerance, axis=-1)
        if self.radius is not None:
            good &= (self.values[start] * self.values[stop]).sum(-1) >= math.cos(0.5 * MAX_STEP_RAD)
        return good

    def greedy(self, possible: np.ndarray) -> cubic_curves.Keys:
        """Greedy keys: each is as far as possible from the previous one, found by galloping and bisection.

        If no interval is within the tolerance, the next key is one candidate step away.
        """
        chosen = [0]
        if not self.constant:
            chosen.extend(possible[self._walk(0, len(possible) - 1)].tolist())
        rows = np.array(chosen)
        slopes = np.zeros_like(self.slopes[rows]) if self.constant else self.slopes[rows]
        return cubic_curves.Keys(self.times[rows], self.values[rows].copy(), slopes.copy(), slopes.copy())

    def _walk(self, start: int, stop: int) -> list[int]:
        """Key positions after ``start`` up to and including ``stop``."""
        taken, position = [], start
        while position < stop and len(taken) < _ONE_BY_ONE:
            position += int(self._reaches(np.array([position]), np.array([stop]))[0])
            taken.append(position)
        if position == stop:
            return taken
        still_needed = (stop - position) * len(taken) // (position - start)
        bounds = np.linspace(position, stop, 1 + max(1, still_needed // _PER_STRIPE)).astype(np.int64)
        at, ends = bounds[:-1].copy(), bounds[1:]
        while len(on := np.flatnonzero(at < ends)):
            at[on] += self._reaches(at[on], ends[on])
            taken.extend(at[on].tolist())
        return self._without_seams(np.array([start, *sorted(set(taken))]), bounds[1:-1])[1:].tolist()

    def _without_seams(self, positions: np.ndarray, seams: np.ndarray) -> np.ndarray:
        """Remove stripe boundaries that need no key.

        Odd and even boundaries are tested alternately, so that no two neighbours are removed at once.
        """
        parity = 0
        while len(seams):
            k = np.searchsorted(positions, seams)
            tried, parity = k % 2 == parity, 1 - parity
            rows = k[tried]
            needless = rows[self._hold(positions[rows - 1], positions[rows + 1])]
            positions, seams = np.delete(positions, needless), seams[~tried]
        return positions

    def _hold(self, starts: np.ndarray, stops: np.ndarray) -> np.ndarray:
        """Mask of the intervals that one cubic reproduces within the tolerance. [n], [n] -> [n] bool"""
        start, stop = starts * _FINER, stops * _FINER
        inside = start[:, None] + np.arange(1, max(2, int((stop - start).max(initial=0))))
        return self._segments_hold(start, stop, np.minimum(inside, stop[:, None] - 1))

    def _reaches(self, positions: np.ndarray, stops: np.ndarray) -> np.ndarray:
        """Number of candidate steps, >= 1, that one cubic can span from each position to its stop. [n], [n] -> [n]"""

        def good(rows: np.ndarray, lengths: np.ndarray) -> np.ndarray:
            return self._hold(positions[rows], positions[rows] + lengths)

        most = stops - positions
        low, high = np.ones_like(most), np.full_like(most, 2)
        rows = np.flatnonzero(high <= most)
        while len(rows):
            rows = rows[good(rows, high[rows])]
            low[rows] = high[rows]
            high[rows] *= 2
            rows = rows[high[rows] <= most[rows]]
        high = np.minimum(high, most + 1)
        rows = np.flatnonzero((low < most) & (most < high))
        low[rows] = np.where(good(rows, most[rows]), most[rows], low[rows])
        while len(rows := np.flatnonzero(high - low > 1)):
            middle = (low[rows] + high[rows]) // 2
            holds = good(rows, middle)
            low[rows] = np.where(holds, middle, low[rows])
            high[rows] = np.where(holds, high[rows], middle)
        return low
