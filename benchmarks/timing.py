"""Time and memory of functions that run in interleaved rounds, each with its own number of torch threads."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from r5dgs_core import timing

SETTLE_S = 0.02  # until threads that wait in a spinning loop give up their cores


class Contender(timing.Contender):
    """A function with the label of its row.

    Attributes:
        label: Other columns of its row.
        torch_threads: Threads of torch's own operations.
        times: Times of a call, after `take_turns`.
        peak_mb: Peak resident memory during a call minus that before it; None if unknown.
    """

    def __init__(self, label: dict[str, Any], run: Callable[[], object], torch_threads: int = 1) -> None:
        super().__init__(run)
        self.label, self.torch_threads = label, torch_threads
        self.times: timing.Times
        self.peak_mb: float | None = None

    def prepare(self) -> None:
        torch.set_num_threads(self.torch_threads)
        super().prepare()

    def take_turn(self) -> tuple[float, float]:
        if torch.get_num_threads() != self.torch_threads:
            torch.set_num_threads(self.torch_threads)
            time.sleep(SETTLE_S)
        return super().take_turn()

    def row(self) -> dict[str, Any]:
        """The label, the smallest processor time, the smallest and median wall time, and the peak memory."""
        return {
            **self.label,
            "cpu_ms": round(self.times.cpu[0], 4),
            "wall_ms_min": round(self.times.wall[0], 4),
            "wall_ms_median": round(self.times.wall[2], 4),
            "peak_mb": None if self.peak_mb is None else round(self.peak_mb, 1),
        }


def take_turns(contenders: Sequence[Contender], turns: int, memory: bool = True) -> None:
    """Time all contenders in interleaved rounds.

    Args:
        contenders: They receive their times and their peak memory.
        turns: Number of rounds; slow contenders take part in fewer.
        memory: True to measure memory. This takes separate calls, which first return freed memory to the system,
            because allocating it again takes time.
    """
    before = torch.get_num_threads()
    try:
        for contender, times in timing.take(dict(enumerate(contenders)), turns).items():
            contenders[contender].times = times
        for contender in contenders if memory else ():
            torch.set_num_threads(contender.torch_threads)
            contender.peak_mb = measure_peak(contender.run)
    finally:
        torch.set_num_threads(before)


def measure_peak(run: Callable[[], object], calls: int = 2) -> float | None:
    """Peak resident memory during a call minus that before it, MB; None if the system does not report it."""
    peaks = []
    for _ in range(calls):
        before = reset_peak_mb()
        if before is None:
            return None
        run()
        peaks.append(status_mb("VmHWM") - before)
    return max(peaks)


def reset_peak_mb() -> float | None:
    """Return freed memory to the system and reset Linux's peak. Returns the current size, or None on other systems."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")
        return status_mb("VmRSS")
    except (OSError, AttributeError, TypeError):
        return None


def status_mb(key: str) -> float:
    """Size of this process by a key of Linux's process status, MB."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key + ":"):
            return int(line.split()[1]) / 1024
    raise OSError(f"/proc/self/status: no {key}")
