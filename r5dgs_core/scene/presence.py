"""Times at which motion groups are absent: before they enter the scene, after they leave it, or in between.

The observed times decide. Between them, a group is as at the nearest one, so it enters and leaves halfway between two
observed times. Before the first and after the last observed time it is as at that time.

Notation: G motion groups, S observed times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .. import errors
from .json_row import Row

Interval = tuple[float, float]  # absent at first <= t < last; infinite if it has no end

HIDDEN = -40.0  # opacity logit of an invisible Gaussian


def intervals(times: np.ndarray, absent: np.ndarray) -> tuple[Interval, ...]:
    """Return the intervals at which a group is absent.

    Args:
        times: Increasing times. [S]
        absent: True if the group is absent at a time. A group that is absent at all times counts as always there. [S]
            bool
    """
    if absent.all():
        return ()
    borders = [-math.inf, *(0.5 * (times[:-1] + times[1:])).tolist(), math.inf]
    changes = np.flatnonzero(np.diff(absent.astype(np.int8), prepend=0, append=0))
    return tuple((borders[first], borders[last]) for first, last in zip(changes[::2], changes[1::2], strict=True))


def is_absent(found: Sequence[Interval], t: float) -> bool:
    """Return True if a scene time is in one of a group's intervals; False for an unknown time (NaN)."""
    return any(first <= t < last for first, last in found)


def span(found: Sequence[Interval]) -> tuple[float, float]:
    """Return the time of a group's first entry and of its last exit, infinite if there is none."""
    edges = [edge for interval in found for edge in interval]
    return (
        edges[1] if edges and edges[0] == -math.inf else -math.inf,
        edges[-2] if edges and edges[-1] == math.inf else math.inf,
    )


def text(found: Sequence[Interval]) -> str:
    """Return the times at which a group enters, is absent and leaves in words; "" if it is always there."""
    enters, leaves = span(found)
    words = [f"enters at {enters:.2f}"] if enters > -math.inf else []
    words += [f"absent from {a:.2f} to {b:.2f}" for a, b in found if math.isfinite(a) and math.isfinite(b)]
    return ", ".join([*words, f"leaves at {leaves:.2f}"] if leaves < math.inf else words)


def absent_rows(every: Sequence[Sequence[Interval]], motion_ids: np.ndarray, t: float) -> np.ndarray | None:
    """Return a mask of the Gaussians of absent groups; None if all groups are there.

    Args:
        every: Intervals of each group. G
        motion_ids: Group of each Gaussian. [N]
        t: Scene time.
    """
    gone = [is_absent(found, t) for found in every]
    return np.array(gone, bool)[motion_ids] if any(gone) else None


def to_json(found: Sequence[Interval]) -> list[list[float | None]]:
    """Return intervals as JSON types, without end as null."""
    return [[edge if math.isfinite(edge) else None for edge in interval] for interval in found]


def read(row: Row) -> tuple[Interval, ...]:
    """Return the intervals of a group's JSON object; inverse of `to_json`. Raises `SceneFileError`."""
    return () if row.lacks("absent") else tuple(_interval(row, pair) for pair in row.get("absent", list))


def _interval(row: Row, pair: object) -> Interval:
    if isinstance(pair, list) and len(pair) == 2:
        numbers = [edge for edge in pair if isinstance(edge, (int, float)) and not isinstance(edge, bool)]
        if len(numbers) == 2 - pair.count(None):
            first, last = pair
            return -math.inf if first is None else float(first), math.inf if last is None else float(last)
    raise errors.SceneFileError(f"{row.place}: absent: expected pairs of numbers or null, found {pair!r:.60}")


def are_sound(found: Sequence[Interval]) -> bool:
    """Return True if intervals are not empty, in order, and apart, and not all times are absent."""
    edges = [edge for interval in found for edge in interval]
    ordered = all(a < b for a, b in zip(edges, edges[1:], strict=False))
    return ordered and all(map(math.isfinite, edges[1:-1])) and edges != [-math.inf, math.inf]
