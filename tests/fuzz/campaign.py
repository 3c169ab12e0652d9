"""Fuzzing of readers with mutated inputs: counts of accepted, rejected and failed inputs, with time and memory.

Seed, reader and index determine an input, so that each one is reproducible.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import resource
import shutil
import signal
import tempfile
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from r5dgs_core.errors import R5dgsError

MAX_SECONDS = 10  # of processor time, for one input
MAX_MEMORY = 1 << 30  # bytes beyond those at the beginning
_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")

Files = dict[str, bytes]


@dataclass(frozen=True)
class Reader:
    """Reader of files under test.

    Attributes:
        name: Its name.
        make: Files of an input, by their paths in a folder.
        read: Reads them and uses what was accepted; a rejection is an `R5dgsError`; any other exception is a defect.
    """

    name: str
    make: Callable[[Random], Files]
    read: Callable[[Path], None]


@dataclass
class Tally:
    """Outcome of a reader's inputs; memory in bytes, beyond that at the beginning."""

    reader: str
    inputs: int = 0
    accepted: int = 0
    refused: int = 0
    uncaught: int = 0
    hangs: int = 0
    peak: int = 0
    seconds: float = 0.0
    faults: Counter[str] = field(default_factory=Counter)

    @property
    def good(self) -> bool:
        """True if no input failed."""
        return not self.uncaught and not self.hangs and self.peak <= MAX_MEMORY

    def row(self) -> str:
        """A line of the table below `HEAD`."""
        return (
            f"{self.reader:12}{self.inputs:8}{self.accepted:10}{self.refused:10}{self.uncaught:10}{self.hangs:7}"
            f"{self.peak / 2**20:10.0f}{self.seconds:9.1f}"
        )


HEAD = (
    f"{'reader':12}{'inputs':>8}{'accepted':>10}{'refused':>10}{'uncaught':>10}{'hangs':>7}{'peak MiB':>10}{'cpu s':>9}"
)


class Hang(BaseException):
    """Raised if an input takes too long; not an `Exception`, so that no reader catches it."""


def run(reader: Reader, indices: range, seed: int, save: Path | None = None) -> Tally:
    """Read some inputs.

    Args:
        reader: The reader.
        indices: Numbers of the inputs.
        seed: Of the random numbers.
        save: Folder for failing inputs, one folder each with the traceback; None keeps none.
    """
    importlib.import_module("torch._dynamo")  # torch imports it late, which takes longer than an input may
    tally = Tally(reader.name)
    started, floor = time.process_time(), _memory()
    memory_files = Path("/dev/shm")
    place = memory_files if memory_files.is_dir() else None
    with tempfile.TemporaryDirectory(prefix="r5dgs-fuzz-", dir=place) as folder, _quiet():
        for index in indices:
            files = reader.make(Random(f"{seed}/{reader.name}/{index}"))
            target = Path(folder, "input")
            for name, content in files.items():
                path = target / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
            _forget_peak()
            fault = _read(reader, target, tally)
            tally.inputs += 1
            peak = max(_memory(peak=True) - floor, 0)
            tally.peak = max(tally.peak, peak)
            if fault is None and peak > MAX_MEMORY:
                fault = f"memory: {peak >> 20} MiB"
            if fault is not None:
                tally.faults[_summary(fault)] += 1
                if save is not None:
                    kept = save / f"{reader.name}-{seed}-{index}"
                    shutil.copytree(target, kept, dirs_exist_ok=True)
                    (kept / "traceback.txt").write_text(fault, encoding="utf-8", errors="replace")
            shutil.rmtree(target)
    tally.seconds = time.process_time() - started
    return tally


def _read(reader: Reader, target: Path, tally: Tally) -> str | None:
    """Read one input and count the outcome; returns the traceback of a defect."""
    try:
        with _limited():
            reader.read(target)
        tally.accepted += 1
    except R5dgsError:
        tally.refused += 1
    except Hang:
        tally.hangs += 1
        return traceback.format_exc()
    except Exception:
        tally.uncaught += 1
        return traceback.format_exc()
    return None


@contextlib.contextmanager
def _limited() -> Iterator[None]:
    """Raise `Hang` in the block after `MAX_SECONDS` of processor time, as soon as Python runs again."""

    def stop(*_: object) -> None:
        raise Hang

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, MAX_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence warnings, logs and the standard error of C libraries."""
    level, kept = logging.root.manager.disable, os.dup(2)
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings(), open(os.devnull, "wb") as nowhere:
            warnings.simplefilter("ignore")
            os.dup2(nowhere.fileno(), 2)
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        logging.disable(level)


def _summary(fault: str) -> str:
    """Return the error and the last line of our code in its traceback."""
    lines = [line.strip() for line in fault.strip().splitlines()]
    ours = [line for line in lines if line.startswith("File ") and "r5dgs_core" in line]
    where = ours[-1].split("r5dgs_core")[-1].replace('", line ', ":") if ours else ""
    return f"{lines[-1][:110]}  [{where}]"


def _memory(peak: bool = False) -> int:
    """Memory of this process, or the most since `_forget_peak`, bytes."""
    if not _STATUS.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
    word = "VmHWM:" if peak else "VmRSS:"
    return int(next(line for line in _STATUS.read_text().splitlines() if line.startswith(word)).split()[1]) << 10


def _forget_peak() -> None:
    with contextlib.suppress(OSError):
        _RESET.write_text("5")
