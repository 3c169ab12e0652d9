"""Offsets of the cameras' clocks: joint solution of pairwise measurements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

GAP = 1.5  # interval / median interval above which frames are missing


@dataclass(frozen=True)
class Offset:
    """Offset of a camera's clock.

    Attributes:
        seconds: Added to the camera's times, it gives the common clock.
        sigma: Its standard deviation, seconds; None if it was not measured.
        method: Source of the value: "audio", "motion", "given", "timestamps.csv" or "none".
    """

    seconds: float
    sigma: float | None
    method: str


def irregularity(times: np.ndarray) -> float:
    """Return the standard deviation of the times of a camera from even intervals, seconds.

    Cameras expose evenly, but a table often holds the times at which a computer received the frames. Their deviations
    are those of successive intervals, whose difference has six times the variance of a time. Intervals of more than
    `GAP` times the median are gaps and do not count.

    Args:
        times: Times of the frames, increasing. [F]
    """
    steps = np.diff(times)
    if len(steps) < 2:
        return 0.0
    even = steps <= GAP * np.median(steps)
    changes = np.diff(steps)[even[1:] & even[:-1]]
    return float(np.sqrt(np.mean(changes**2) / 6)) if len(changes) else 0.0


def solve_pairs(count: int, pairs: Sequence[tuple[int, int, float, float]], method: str) -> list[Offset] | None:
    """Solve for the offsets of all cameras.

    Args:
        count: Number of cameras.
        pairs: By cameras (a, b): offset to add to the times of b to get those of a, and its standard deviation.
        method: Method of the offsets.

    Returns:
        Offsets relative to the first camera of the largest group that pairs connect. Cameras outside this group have
        offset 0 and no uncertainty. None if there is no pair.
    """
    group = _largest_group(count, pairs)
    if len(group) < 2:
        return None
    place = {camera: k for k, camera in enumerate(group)}
    pairs = [(place[a], place[b], offset, sigma) for a, b, offset, sigma in pairs if a in place]
    size = len(group)
    rows, wanted = np.zeros((len(pairs), size)), np.zeros(len(pairs))
    weights = np.array([1.0 / sigma for *_, sigma in pairs])
    for row, (a, b, offset, _) in enumerate(pairs):
        rows[row, b], rows[row, a], wanted[row] = 1.0, -1.0, offset
    robust = weights.copy()
    solution, off = np.zeros(size), np.zeros(len(pairs))
    for _ in range(10):  # least squares with Huber weights, so that one wrong pair does not spoil the others
        part = np.linalg.lstsq(robust[:, None] * rows[:, 1:], robust * wanted, rcond=None)[0]
        solution[1:] = part
        off = np.abs(rows @ solution - wanted) * weights
        robust = weights * np.sqrt(np.minimum(1.0, 2.0 / np.maximum(off, 1e-12)))
    normal = (robust[:, None] * rows[:, 1:]).T @ (robust[:, None] * rows[:, 1:])
    misfit = max(1.0, float(np.sqrt(np.mean(np.minimum(off, 2.0) ** 2)))) if len(pairs) >= size else 1.0
    sigmas = np.concatenate([[0.0], np.sqrt(np.diag(np.linalg.inv(normal))) * misfit])
    result = [Offset(0.0, None, "none")] * count
    for camera, value, sigma in zip(group, solution, sigmas, strict=True):
        result[camera] = Offset(float(value), float(sigma), method)
    return result


def _largest_group(count: int, pairs: Sequence[tuple[int, int, float, float]]) -> list[int]:
    """Return the largest group of cameras that pairs connect, in order."""
    group = list(range(count))
    for a, b, _, _ in pairs:
        low, high = sorted((group[a], group[b]))
        group = [low if one == high else one for one in group]
    largest = max(group, key=lambda one: (group.count(one), -one))
    return [camera for camera in range(count) if group[camera] == largest]
