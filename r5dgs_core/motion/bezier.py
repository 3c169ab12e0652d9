"""Cubic Bezier segments of animation curves: evaluation and exact subdivision.

A segment is four points (time, value): a key, its right handle, the next key's left handle, that key. [4, 2]
"""

from __future__ import annotations

import numpy as np

_HALVINGS = 54  # bisection steps of the curve parameter, down to rounding


def clamp_handles(segment: np.ndarray) -> np.ndarray:
    """Shorten handles that reach past the other key, as Blender does on evaluation. [4, 2] -> [4, 2]

    Handles may still overlap; time stays monotonic along the curve.
    """
    segment = np.array(segment, np.float64)
    length = segment[3, 0] - segment[0, 0]
    for key, handle in ((0, 1), (3, 2)):
        reach = abs(segment[handle, 0] - segment[key, 0])
        if reach > length:
            segment[handle] = segment[key] + length / reach * (segment[handle] - segment[key])
    return segment


def line(start: np.ndarray, stop: np.ndarray) -> np.ndarray:
    """Straight segment with constant speed between two points. [2], [2] -> [4, 2]"""
    return start + np.array([[0.0], [1 / 3], [2 / 3], [1.0]]) * (stop - start)


def split(segment: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Split a segment at a time without changing the curve (de Casteljau).

    `clamp_handles` would shorten a handle of a part that reaches past the part's other key. This can happen only if
    both handles of the whole segment span more than two thirds of it, and only in the part that contains the parameter
    at which time advances slowest. That part is therefore split once more at this parameter: on either side of it, the
    control times of the cubic lie between its ends.

    Args:
        segment: Key, handle, handle, key, the keys in order of time. [4, 2]
        time: Strictly between the keys.

    Returns:
        The segments before that time and those after it, one or two each, in order. [n, 4, 2]
    """
    points = clamp_handles(segment)
    if not points[0, 0] < time < points[3, 0]:
        raise ValueError(f"time: expected between {points[0, 0]} and {points[3, 0]}, got {time}")
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _levels(points, middle)[-1][0, 0] < time else (low, middle)
    share = 0.5 * (low + high)
    slowest = _slowest(points[:, 0])
    before, after = _halves(points, share)
    parts = (before[None], after[None])
    if (clamp_handles(before) != before).any() and 0 < slowest < share:
        parts = (np.stack(_halves(before, slowest / share)), parts[1])
    if (clamp_handles(after) != after).any() and share < slowest < 1:
        parts = (parts[0], np.stack(_halves(after, (slowest - share) / (1 - share))))
    return parts


def _slowest(times: np.ndarray) -> float:
    """Parameter at which a cubic with these control times is slowest, or NaN if it has no minimum speed."""
    bends = np.diff(times, 2)
    return float(-bends[0] / (bends[1] - bends[0])) if bends[1] > bends[0] else np.nan


def _halves(points: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Split the control points at a parameter value. [4, 2] each"""
    levels = _levels(points, share)
    return np.stack([level[0] for level in levels]), np.stack([level[-1] for level in reversed(levels)])


def _levels(points: np.ndarray, share: float) -> list[np.ndarray]:
    """Control points of each de Casteljau level: [4, 2], [3, 2], [2, 2], [1, 2]."""
    levels = [points]
    while len(levels[-1]) > 1:
        levels.append((1 - share) * levels[-1][:-1] + share * levels[-1][1:])
    return levels


def evaluate(segments: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values and slopes of a piecewise curve. At a key, those of the segment that starts there.

    Args:
        segments: Consecutive, each ending at the key at which the next begins. [K, 4, 2]
        times: Within the curve. [S]

    Returns:
        Values [S] and slopes per unit of time [S].
    """
    points = np.stack([clamp_handles(segment) for segment in segments])
    starts = points[:, 0, 0]
    chosen = points[np.clip(np.searchsorted(starts, times, side="right") - 1, 0, len(points) - 1)]  # [S, 4, 2]
    x, y = chosen[..., 0], chosen[..., 1]
    low, high = np.zeros(len(times)), np.ones(len(times))
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        before = _cubic(x, middle) < times
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    share = 0.5 * (low + high)
    run, rise = _cubic_derivative(x, share), _cubic_derivative(y, share)
    return _cubic(y, share), np.divide(rise, run, out=np.zeros_like(rise), where=np.abs(run) > 1e-12)


def _cubic(points: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Evaluate Bezier control values at a parameter. [S, 4], [S] -> [S]"""
    rest = 1 - share
    weights = np.stack([rest**3, 3 * share * rest**2, 3 * share**2 * rest, share**3], axis=-1)
    return (weights * points).sum(-1)


def _cubic_derivative(points: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Derivative of `_cubic` with respect to the parameter. [S, 4], [S] -> [S]"""
    rest = 1 - share
    weights = np.stack([rest**2, 2 * share * rest, share**2], axis=-1)
    return 3 * (weights * np.diff(points, axis=-1)).sum(-1)
