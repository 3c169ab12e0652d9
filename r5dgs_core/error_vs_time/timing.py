"""Timing of several callables in interleaved rounds, so that background load affects all of them equally."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

CLOCKS = ("wall", "cpu")
SAMPLE_MS = 4.0  # minimum duration of a turn, milliseconds; shorter calls are repeated
MOST_CALLS = 1000  # maximum calls per turn
BUSY = 1.25  # ratio of wall to single-thread processor time above which the machine counts as busy
Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class Times:
    """Times of one call in milliseconds: lower quartile, median and upper quartile over rounds.

    Attributes:
        wall: Wall time of the fastest call of each turn. [3]
        cpu: Processor time over all threads, mean of each turn. [3]
    """

    wall: np.ndarray
    cpu: np.ndarray

    def __add__(self, other: Times) -> Times:
        """Return the times of both calls in sequence."""
        return Times(self.wall + other.wall, self.cpu + other.cpu)

    def scaled(self, factor: float) -> Times:
        """Return the times multiplied by a factor, such as one over the frames of a call."""
        return Times(factor * self.wall, factor * self.cpu)

    def columns(self, clock: str = "wall") -> dict[str, float]:
        """Return columns of `report_rows.Row`: ``ms`` and its quartiles by a clock of `CLOCKS`, and both medians."""
        low, middle, high = (self.wall if clock == "wall" else self.cpu).tolist()
        both = {"ms_wall": float(self.wall[1]), "ms_cpu": float(self.cpu[1])}
        return {"ms": middle, "ms_low": low, "ms_high": high, **both}

    def ms(self, clock: str = "wall") -> float:
        """Return the median by a clock."""
        return float((self.wall if clock == "wall" else self.cpu)[1])


def take(calls: Mapping[Key, Callable[[], object]], rounds: int) -> dict[Key, Times]:
    """Benchmark callables in interleaved rounds.

    Args:
        calls: The callables. The first call of each compiles and is not counted; the second determines the repeats.
        rounds: Turns of each, >= 1; every other round is reversed, so that no call always follows the same one.

    Returns:
        Times by the keys of ``calls``.
    """
    if rounds < 1:
        raise ValueError(f"rounds: expected 1 or more, got {rounds}")
    repeats = {}
    for key, call in calls.items():
        call()
        start = time.process_time()
        call()
        once = 1e3 * (time.process_time() - start)
        repeats[key] = int(np.clip(np.ceil(SAMPLE_MS / max(once, 1e-6)), 1, MOST_CALLS))
    found: dict[Key, list[tuple[float, float]]] = {key: [] for key in calls}
    for number in range(rounds):
        order = list(calls) if number % 2 == 0 else list(calls)[::-1]
        for key in order:
            found[key].append(_turn(calls[key], repeats[key]))
    return {key: _times(np.array(values)) for key, values in found.items()}


def _turn(call: Callable[[], object], count: int) -> tuple[float, float]:
    """Return the wall time of the fastest, undisturbed call and the mean processor time, milliseconds."""
    fastest, began = float("inf"), time.process_time()
    for _ in range(count):
        start = time.perf_counter()
        call()
        fastest = min(fastest, time.perf_counter() - start)
    return 1e3 * fastest, 1e3 * (time.process_time() - began) / count


def _times(values: np.ndarray) -> Times:
    wall, cpu = np.quantile(values, [0.25, 0.5, 0.75], axis=0).T
    return Times(wall, cpu)
