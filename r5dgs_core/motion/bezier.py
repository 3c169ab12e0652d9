"""Bezier segments between two keys of a curve over time, as animation editors keep them: cut without changing them.

A segment is four points (time, value): a key, its right handle, the next key's left handle, that key. [4, 2]
"""

from __future__ import annotations

import numpy as np

_HALVINGS = 54  # of the parameter's range: down to rounding


def within(segment: np.ndarray) -> np.ndarray:
    """The segment as Blender evaluates it: a handle that reaches past the other key is shortened. [4, 2] -> [4, 2]

    Handles may overlap: the curve goes on in time all the same.
    """
    segment = np.array(segment, np.float64)
    length = segment[3, 0] - segment[0, 0]
    for key, handle in ((0, 1), (3, 2)):
        reach = abs(segment[handle, 0] - segment[key, 0])
        if reach > length:
            segment[handle] = segment[key] + length / reach * (segment[handle] - segment[key])
    return segment


def split(segment: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Cut a segment at a time into two that are the same curve together (de Casteljau).

    Where both handles reach over more than 0.8 of the segment, a part's handle may reach past its own key, and is
    then shortened as `within` does.

    Args:
        segment: Key, handle, handle, key, the keys in order of time. [4, 2]
        time: Strictly between the keys.

    Returns:
        The part before that time and the part after it. [4, 2] each
    """
    points = within(segment)
    if not points[0, 0] < time < points[3, 0]:
        raise ValueError(f"time: expected between {points[0, 0]} and {points[3, 0]}, got {time}")
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _levels(points, middle)[-1][0, 0] < time else (low, middle)
    levels = _levels(points, 0.5 * (low + high))
    return np.stack([level[0] for level in levels]), np.stack([level[-1] for level in reversed(levels)])


def _levels(points: np.ndarray, share: float) -> list[np.ndarray]:
    """The points and their repeated means: [4, 2], [3, 2], [2, 2], [1, 2]."""
    levels = [points]
    while len(levels[-1]) > 1:
        levels.append((1 - share) * levels[-1][:-1] + share * levels[-1][1:])
    return levels


def evaluate(segments: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values and slopes of a curve of segments, at times within it; at a key, those of the segment that starts there.

    Args:
        segments: Consecutive, each ending at the key where the next begins. [K, 4, 2]
        times: [S]

    Returns:
        Values [S] and slopes per unit of time [S].
    """
    points = np.stack([within(segment) for segment in segments])
    starts = points[:, 0, 0]
    chosen = points[np.clip(np.searchsorted(starts, times, side="right") - 1, 0, len(points) - 1)]  # [S, 4, 2]
    x, y = chosen[..., 0], chosen[..., 1]
    low, high = np.zeros(len(times)), np.ones(len(times))
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        before = _cubic(x, middle) < times
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    share = 0.5 * (low + high)
    run, rise = _rate(x, share), _rate(y, share)
    return _cubic(y, share), np.divide(rise, run, out=np.zeros_like(rise), where=np.abs(run) > 1e-12)


def _cubic(points: np.ndarray, share: np.ndarray) -> np.ndarray:
    """[S, 4], [S] -> [S]"""
    rest = 1 - share
    weights = np.stack([rest**3, 3 * share * rest**2, 3 * share**2 * rest, share**3], axis=-1)
    return (weights * points).sum(-1)


def _rate(points: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Derivative of `_cubic` by the share. [S, 4], [S] -> [S]"""
    rest = 1 - share
    weights = np.stack([rest**2, 2 * share * rest, share**2], axis=-1)
    return 3 * (weights * np.diff(points, axis=-1)).sum(-1)
