"""Curves through knots whose slopes jump at known times, such as the velocity of a body that hits another.

The slopes of a cubic through knots are continuous, which rounds a jump over the interval between two knots. Here the
knots before and after a jump determine slopes by themselves, and the curve gets a key at the time of the jump.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from . import cubic_curves
from .cubic_curves import Keys

_AT_KNOT = 0.01  # distance from a knot, in intervals, at which a jump is at the knot


def keys(times: np.ndarray, values: np.ndarray, jumps: Sequence[float]) -> Keys:
    """Keys through all knots, with further ones at jumps.

    A jump is left out, and the curve stays smooth there, if fewer than two knots are on one side, or if the motions of
    both sides, continued to its time, meet less well than they depart from the smooth curve.

    Args:
        times: Times of the knots, increasing. [S]
        values: Values at the knots. [S, C]
        jumps: Times at which slopes jump.
    """
    slopes = cubic_curves.slopes(times, values)
    found = Keys(times, values, slopes, slopes.copy())
    kept: list[float] = []
    for jump in sorted(jumps) if len(times) > 2 else ():
        sharp = _split(times, values, [*kept, jump])
        if sharp is not None and _meets(sharp, found, times, values, jump):
            kept.append(jump)
            found = sharp
    return found


def _split(times: np.ndarray, values: np.ndarray, jumps: Sequence[float]) -> Keys | None:
    """Keys with all jumps, or None if a side of one has fewer than two knots."""
    starts, stops, between = [0], [], []
    for jump in jumps:
        k, h, u = cubic_curves.locate(times, jump)
        k = int(k)
        at_knot = min(u, 1 - u) < _AT_KNOT
        last = k + round(float(u)) if at_knot else k
        stops.append(last + 1)
        starts.append(last if at_knot else k + 1)
        between.append(None if at_knot else jump)
    stops.append(len(times))
    if any(stop - start < 2 for start, stop in zip(starts, stops, strict=True)):
        return None
    pieces = []
    for number, (start, stop) in enumerate(zip(starts, stops, strict=True)):
        t, v = times[start:stop], values[start:stop]
        slopes = cubic_curves.slopes(t, v)
        piece = Keys(t, v, slopes, slopes.copy())
        before = between[number - 1] if number else None
        after = between[number] if number < len(between) else None
        pieces.append(_reaching(piece, before, after))
    return _joined(pieces)


def _reaching(piece: Keys, before: float | None, after: float | None) -> Keys:
    """Keys of one side, continued to the jumps before its first and after its last knot by parabolas."""
    t, v, slopes = piece.times, piece.values, piece.left_slopes
    if before is not None:
        place, slope = _continued(t[::-1], v[::-1], slopes[0], before)
        t, v, slopes = np.append(before, t), np.vstack([place, v]), np.vstack([slope, slopes])
    if after is not None:
        place, slope = _continued(piece.times, piece.values, piece.left_slopes[-1], after)
        t, v, slopes = np.append(t, after), np.vstack([v, place]), np.vstack([slopes, slope])
    return Keys(t, v, slopes, slopes.copy())


def _continued(times: np.ndarray, values: np.ndarray, slope: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Value and slope at a time past the last of some knots, on the parabola through the last three. [C], [C]"""
    step = times[-1] - times[-2]
    secant = (values[-1] - values[-2]) / step
    bend = (slope - secant) * (2 / step)  # zero for two knots
    ahead = t - times[-1]
    return values[-1] + ahead * slope + 0.5 * ahead * ahead * bend, slope + ahead * bend


def _joined(pieces: list[Keys]) -> Keys:
    """One curve from pieces that begin where the previous one ends; their end values may differ."""
    first, *others = pieces
    for second in others:
        share = _share(first, second)
        meeting = (1 - share) * first.values[-1] + share * second.values[0]
        first = Keys(
            np.concatenate([first.times, second.times[1:]]),
            np.concatenate([first.values[:-1], meeting[None], second.values[1:]]),
            np.concatenate([first.left_slopes, second.left_slopes[1:]]),
            np.concatenate([first.right_slopes[:-1], second.right_slopes]),
        )
    return first


def _share(first: Keys, second: Keys) -> float:
    """Weight of the second side at a meeting: the nearer its knot, the larger."""
    before, after = first.times[-1] - first.times[-2], second.times[1] - second.times[0]
    return float(before / (before + after))


def _meets(sharp: Keys, smooth: Keys, times: np.ndarray, values: np.ndarray, jump: float) -> bool:
    """True if both sides of the last jump meet better than they depart from the smooth curve."""
    if len(sharp.times) == len(smooth.times):
        return True  # at a knot, where both sides meet
    k = int(np.searchsorted(sharp.times, jump))
    row = int(np.searchsorted(times, jump))
    sides = []
    for t, v, slope in (
        (times[:row], values[:row], sharp.left_slopes[k - 1]),
        (times[row:][::-1], values[row:][::-1], sharp.right_slopes[k + 1]),
    ):
        sides.append(_continued(t, v, slope, jump)[0])
    gap = np.linalg.norm(sides[0] - sides[1])
    return bool(gap < np.linalg.norm(sharp.values[k] - cubic_curves.evaluate(smooth, np.array(jump))))
