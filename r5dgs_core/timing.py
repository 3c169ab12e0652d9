"""Timing: laps of consecutive steps, and interleaved rounds of several callables.

Rounds are interleaved so that background load affects all callables equally.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

CLOCKS = {"wall": "wall time", "cpu": "processor time over all threads"}
SHORT_CLOCKS = {"wall": "wall", "cpu": "processor"}
SAMPLE_MS = 4.0  # minimum duration of a turn, milliseconds; shorter calls are repeated
MAX_CALLS = 1000  # maximum calls per turn
PATIENCE_MS = 30_000.0  # time of a contender's turns after which it takes at most `ENOUGH`
ENOUGH = 3
BUSY = 1.25  # ratio of wall to single-thread processor time above which the machine counts as busy
Key = TypeVar("Key", bound=Hashable)


class Stopwatch:
    """Wall time of consecutive steps."""

    def __init__(self) -> None:
        self._start = time.perf_counter()

    def lap(self) -> float:
        """Return the milliseconds since the last lap, or since the start."""
        now = time.perf_counter()
        ms, self._start = 1e3 * (now - self._start), now
        return ms


@dataclass(frozen=True)
class Times:
    """Times of one call in milliseconds: minimum, lower quartile, median and upper quartile over turns.

    Attributes:
        wall: Wall time of the fastest call of each turn. [4]
        cpu: Processor time over all threads, mean of each turn. [4]
    """

    wall: np.ndarray
    cpu: np.ndarray

    def __add__(self, other: Times) -> Times:
        """Return the times of both calls in sequence."""
        return Times(self.wall + other.wall, self.cpu + other.cpu)

    def scaled(self, factor: float) -> Times:
        """Return the times multiplied by a factor, such as one over the frames of a call."""
        return Times(factor * self.wall, factor * self.cpu)

    def columns(self, clock: str = "wall") -> dict[str, Any]:
        """Return columns of `report_rows.Row`: the clock, ``ms`` and its quartiles by that clock, and both medians."""
        _, low, middle, high = (self.wall if clock == "wall" else self.cpu).tolist()
        both = {"ms_wall": float(self.wall[2]), "ms_cpu": float(self.cpu[2])}
        return {"clock": clock, "ms": middle, "ms_low": low, "ms_high": high, **both}

    def ms(self, clock: str = "wall") -> float:
        """Return the median by a clock."""
        return float((self.wall if clock == "wall" else self.cpu)[2])


class Contender:
    """A callable that takes turns with others.

    Attributes:
        run: One call.
        calls: Calls per turn.
    """

    def __init__(self, run: Callable[[], object]) -> None:
        self.run = run
        self.calls = 1

    def prepare(self) -> None:
        """Call twice without counting: the first call compiles, the second determines the calls per turn."""
        self.run()
        start = time.perf_counter()
        self.run()
        once = 1e3 * (time.perf_counter() - start)
        self.calls = int(np.clip(np.ceil(SAMPLE_MS / max(once, 1e-6)), 1, MAX_CALLS))

    def take_turn(self) -> tuple[float, float]:
        """Return the wall time of the fastest, undisturbed call and the mean processor time, milliseconds."""
        fastest, began, spent, done = float("inf"), time.process_time(), 0.0, 0
        while done < self.calls or (spent == 0 and done < MAX_CALLS):  # some clocks advance by 10 ms at a time
            start = time.perf_counter()
            self.run()
            fastest = min(fastest, time.perf_counter() - start)
            spent, done = time.process_time() - began, done + 1
        return 1e3 * fastest, 1e3 * spent / done


def take(calls: Mapping[Key, Callable[[], object] | Contender], rounds: int) -> dict[Key, Times]:
    """Time callables in interleaved rounds.

    Args:
        calls: The callables, or contenders with their own way to take turns.
        rounds: Turns of each, >= 1; slow ones take fewer (`PATIENCE_MS`). Every other round is reversed, so that no
            call always follows the same one.

    Returns:
        Times by the keys of ``calls``.
    """
    if rounds < 1:
        raise ValueError(f"rounds: expected 1 or more, got {rounds}")
    contenders = {key: call if isinstance(call, Contender) else Contender(call) for key, call in calls.items()}
    for contender in contenders.values():
        contender.prepare()
    found: dict[Key, list[tuple[float, float]]] = {key: [] for key in calls}
    for number in range(rounds):
        for key in list(calls) if number % 2 == 0 else list(calls)[::-1]:
            spent = contenders[key].calls * sum(wall for wall, _ in found[key])
            if len(found[key]) < ENOUGH or spent < PATIENCE_MS:
                found[key].append(contenders[key].take_turn())
    return {key: _times(np.array(values)) for key, values in found.items()}


def _times(values: np.ndarray) -> Times:
    wall, cpu = np.quantile(values, [0, 0.25, 0.5, 0.75], axis=0).T
    return Times(wall, cpu)
