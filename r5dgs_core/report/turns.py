"""Timing several ways to do the same: they take turns, so that what else the machine does meets all of them alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

SAMPLE_MS = 4.0  # a turn repeats its call until it lasts this long
MOST_CALLS = 1000
Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class Times:
    """Times of one call in milliseconds, over rounds.

    Attributes:
        ms: Median.
        low: Lower quartile.
        high: Upper quartile.
        cpu: Median of the processor time, over all threads.
    """

    ms: float
    low: float
    high: float
    cpu: float

    def __add__(self, other: Times) -> Times:
        """Of one call after the other."""
        return Times(self.ms + other.ms, self.low + other.low, self.high + other.high, self.cpu + other.cpu)

    def scaled(self, factor: float) -> Times:
        """Times by a factor, such as one over the frames of a call."""
        return Times(factor * self.ms, factor * self.low, factor * self.high, factor * self.cpu)

    def columns(self) -> dict[str, float]:
        """By the names of `report_rows.Row`."""
        return {"ms": self.ms, "ms_low": self.low, "ms_high": self.high, "ms_cpu": self.cpu}


def take(calls: Mapping[Key, Callable[[], object]], rounds: int) -> dict[Key, Times]:
    """Time calls in rounds over all of them.

    Args:
        calls: What to time. A first call of each does not count: it compiles, and tells how often to repeat.
        rounds: Turns of each, >= 1; every other round goes backwards, so that none is always after the same one.

    Returns:
        The times, by the keys of ``calls``.
    """
    if rounds < 1:
        raise ValueError(f"rounds: expected 1 or more, got {rounds}")
    repeats = {}
    for key, call in calls.items():
        call()
        start = time.perf_counter()
        call()
        once = 1e3 * (time.perf_counter() - start)
        repeats[key] = int(np.clip(np.ceil(SAMPLE_MS / max(once, 1e-6)), 1, MOST_CALLS))
    found: dict[Key, list[tuple[float, float]]] = {key: [] for key in calls}
    for number in range(rounds):
        order = list(calls) if number % 2 == 0 else list(calls)[::-1]
        for key in order:
            call, count = calls[key], repeats[key]
            cpu, start = time.process_time(), time.perf_counter()
            for _ in range(count):
                call()
            wall = time.perf_counter() - start
            found[key].append((1e3 * wall / count, 1e3 * (time.process_time() - cpu) / count))
    return {key: _times(np.array(values)) for key, values in found.items()}


def _times(values: np.ndarray) -> Times:
    low, middle, high = np.quantile(values[:, 0], [0.25, 0.5, 0.75])
    return Times(float(middle), float(low), float(high), float(np.median(values[:, 1])))
