"""Choice of the frames that become images, and their times.

The frames of the slowest camera are the *moments*. Each other camera gives the frame nearest to each moment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .. import errors

SAME_S, SAME_SHARE = 1e-3, 0.03  # frames of a moment count as simultaneous within this time, or share of the interval


@dataclass(frozen=True)
class Window:
    """Requested part of a recording.

    Attributes:
        start: First time, seconds from the first time at which all cameras record.
        end: Last time, or None.
        every: Use every n-th moment.
        fps: Moments per second, or None for all.
    """

    start: float = 0.0
    end: float | None = None
    every: int = 1
    fps: float | None = None


@dataclass(frozen=True)
class Choice:
    """Chosen frames.

    Attributes:
        indices: Indices of each camera's frames, increasing. C arrays [F]
        times: Their times on the common clock, seconds. C arrays [F]
        moments: Number of the moment of each frame. C arrays [F]
        interval: Median time between two moments, seconds.
        source_interval: Median time between two frames of the slowest camera, seconds.
        spans: First and last time of each camera's recording, seconds. [C, 2]
    """

    indices: tuple[np.ndarray, ...]
    times: tuple[np.ndarray, ...]
    moments: tuple[np.ndarray, ...]
    interval: float
    source_interval: float
    spans: np.ndarray


def choose(names: Sequence[str], clocks: Sequence[np.ndarray], window: Window) -> Choice:
    """Choose frames.

    Args:
        names: Names of the cameras.
        clocks: Times of all frames of each camera on the common clock, seconds. C arrays
        window: The requested part.

    Raises:
        DatasetError: The cameras never record at the same time, or no frame is in the window.
    """
    steps = [float(np.median(np.diff(times))) if len(times) > 1 else 0.0 for times in clocks]
    alike = [k for k, step in enumerate(steps) if step >= 0.95 * max(steps)]
    slowest = max(alike, key=lambda k: len(clocks[k]))  # one that dropped frames would drop moments
    first, last = max(times[0] for times in clocks), min(times[-1] for times in clocks)
    slack = 0.5 * max(steps) + SAME_S
    if last < first - slack:
        early, late = int(np.argmin([t[-1] for t in clocks])), int(np.argmax([t[0] for t in clocks]))
        raise errors.DatasetError(
            f"the recordings have no overlap: {names[early]} ends {first - last:.2f} s before {names[late]} begins. "
            "Remedy: remove one of them, or correct their clocks with --offset NAME=MS or timestamps.csv"
        )
    # Without a start, the first moment counts even if cameras begin up to half an interval apart.
    low = first - slack if window.start <= 0 else max(first - slack, first + window.start - SAME_S)
    high = last + slack if window.end is None else min(last + slack, first + window.end + SAME_S)
    grid = clocks[slowest]
    grid = _thinned(grid[(grid >= low) & (grid <= high)], window)
    if not len(grid):
        raise errors.DatasetError(
            f"no frame from {window.start:g} s to {'the end' if window.end is None else f'{window.end:g} s'}: the "
            f"cameras record together for {max(last - first, 0):.2f} s; correct --start and --end"
        )
    interval = float(np.median(np.diff(grid))) if len(grid) > 1 else max(steps)
    nearest = [_nearest(times, grid, step) for times, step in zip(clocks, steps, strict=True)]
    times = [np.where(index >= 0, own[index], np.nan) for own, index in zip(clocks, nearest, strict=True)]
    times = _simultaneous(np.stack(times), max(SAME_S, SAME_SHARE * interval))
    kept = [index >= 0 for index in nearest]
    return Choice(
        indices=tuple(index[keep] for index, keep in zip(nearest, kept, strict=True)),
        times=tuple(row[keep] for row, keep in zip(times, kept, strict=True)),
        moments=tuple(np.flatnonzero(keep) for keep in kept),
        interval=interval,
        source_interval=max(steps),
        spans=np.array([(times[0], times[-1]) for times in clocks]),
    )


def _thinned(grid: np.ndarray, window: Window) -> np.ndarray:
    """Return every n-th moment, and of these the nearest to the requested rate. [G] -> [G']"""
    grid = grid[:: window.every]
    if window.fps is None or len(grid) < 2 or window.fps * np.diff(grid).min() >= 1:
        return grid
    wanted = np.arange(grid[0], grid[-1] + 0.5 / window.fps, 1.0 / window.fps)
    return grid[np.unique(nearest_of(grid, wanted))]


def nearest_of(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the index of the time nearest to each wanted time. [F] increasing, [G] -> [G]"""
    above = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
    below = np.maximum(above - 1, 0)
    return np.where(wanted - times[below] <= times[above] - wanted, below, above)


def _nearest(times: np.ndarray, grid: np.ndarray, step: float) -> np.ndarray:
    """Index of the frame nearest to each moment; -1 if none is near or the frame is nearer to another moment. [G]"""
    index = nearest_of(times, grid)
    own = nearest_of(grid, times[index]) == np.arange(len(grid))
    gap = float(np.median(np.diff(grid))) if len(grid) > 1 else np.inf
    near = np.abs(times[index] - grid) <= 0.5 * max(min(gap, 2 * step), step) + SAME_S
    return np.where(own & near, index, -1)


def _simultaneous(times: np.ndarray, tolerance: float) -> np.ndarray:
    """Give the frames of a moment one time if they differ by no more than the tolerance. [C, G]"""
    low, high = np.nanmin(times, axis=0), np.nanmax(times, axis=0)
    same = high - low <= tolerance
    return np.where(same & np.isfinite(times), 0.5 * (low + high), times)


def replace_indices(choice: Choice, indices: tuple[np.ndarray, ...]) -> Choice:
    """Return the choice with other indices of the frames. C arrays [F]"""
    return replace(choice, indices=indices)
