"""Timing in interleaved rounds, so that background load affects all contenders equally."""

from __future__ import annotations

import ctypes
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

TURN_MS = 60.0  # a turn is one call, and more while all of them together stay below this
PATIENCE_S = 30.0  # who has used so much leaves after `ENOUGH` turns
ENOUGH = 3
SETTLE_S = 0.02  # until threads that wait in a spinning loop give up their cores


@dataclass
class Contender:
    """A timed function and its times.

    Attributes:
        label: Other columns of its row.
        run: One call.
        torch_threads: Threads of torch's own operations.
        cpu_ms: Processor time of each call, over all threads.
        wall_ms: Time of each call.
        turns: Turns taken.
        peak_mb: Largest resident memory during a call beyond that before it; None if the system does not report it.
    """

    label: dict[str, Any]
    run: Callable[[], object]
    torch_threads: int = 1
    cpu_ms: list[float] = field(default_factory=list)
    wall_ms: list[float] = field(default_factory=list)
    turns: int = 0
    peak_mb: float | None = None

    def warm_up(self) -> None:
        """One call that does not count."""
        self.run()

    def take_turn(self) -> None:
        """Calls that count, see `TURN_MS`."""
        self.turns += 1
        spent = 0.0
        while True:
            cpu_start, wall_start = time.process_time(), time.perf_counter()
            self.run()
            wall = 1e3 * (time.perf_counter() - wall_start)
            self.cpu_ms.append(1e3 * (time.process_time() - cpu_start))
            self.wall_ms.append(wall)
            spent += wall
            if spent + wall > TURN_MS:
                return

    def row(self) -> dict[str, Any]:
        """The label and the figures: smallest processor time, smallest and median wall time, peak memory."""
        return {
            **self.label,
            "cpu_ms": round(min(self.cpu_ms), 3),
            "wall_ms_min": round(min(self.wall_ms), 3),
            "wall_ms_median": round(statistics.median(self.wall_ms), 3),
            "peak_mb": None if self.peak_mb is None else round(self.peak_mb, 1),
        }


def take_turns(contenders: Sequence[Contender], turns: int, memory: bool = True) -> None:
    """Time all contenders: after a warm-up of each, one turn of each after the other, again and again.

    Args:
        contenders: Get their times.
        turns: Turns of each; slow ones take fewer (see `PATIENCE_S`).
        memory: Whether to measure memory as well, in calls of their own: for that, freed memory is given back to the
            system first, and asking for it again takes time.
    """
    spinning = any(contender.torch_threads > 1 for contender in contenders)
    before = torch.get_num_threads()
    try:
        for contender in contenders:
            torch.set_num_threads(contender.torch_threads)
            contender.warm_up()
            if memory:
                contender.peak_mb = measure_peak(contender.run)
        for _ in range(turns):
            for contender in contenders:
                if contender.turns >= ENOUGH and sum(contender.wall_ms) > 1e3 * PATIENCE_S:
                    continue
                torch.set_num_threads(contender.torch_threads)
                if spinning:
                    time.sleep(SETTLE_S)
                contender.take_turn()
    finally:
        torch.set_num_threads(before)


def measure_peak(run: Callable[[], object], calls: int = 2) -> float | None:
    """Largest resident memory during a call beyond that before it, MB; None on systems that do not tell."""
    peaks = []
    for _ in range(calls):
        before = reset_peak_mb()
        if before is None:
            return None
        run()
        peaks.append(status_mb("VmHWM") - before)
    return max(peaks)


def reset_peak_mb() -> float | None:
    """Give freed memory back and let Linux forget its largest size; returns the present one, None on other systems."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")
        return status_mb("VmRSS")
    except (OSError, AttributeError, TypeError):
        return None


def status_mb(key: str) -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key + ":"):
            return int(line.split()[1]) / 1024
    raise OSError(f"/proc/self/status: no {key}")
