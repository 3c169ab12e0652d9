"""Training in a process of its own, so that its processor time and memory are its own, too."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# The system's largest size of a process counts its parent's, too, which it was forked from; so it tells its own.
_CHILD = """
import sys
from r5dgs_core.cli import main as cli
from r5dgs_core.bench import process
try:
    status = cli.main(sys.argv[1:])
finally:
    process.tell_peak()
sys.exit(status)
"""
STOPPED = 130


@dataclass(frozen=True)
class Sitting:
    """One process that trained.

    Attributes:
        status: Its exit status, negative for the signal that ended it.
        complaint: The last line that it wrote on stderr, "" without one.
        cpu_seconds: Processor time of all its threads, start and end of Python included; None where unknown.
        wall_seconds: From start to end.
        peak_mb: Its largest resident memory, 2^20 bytes; None where unknown.
        peak_gpu_mb: The most that torch reserved on a GPU; None where it used none.
    """

    status: int
    complaint: str
    cpu_seconds: float | None
    wall_seconds: float
    peak_mb: float | None
    peak_gpu_mb: float | None


def train(
    arguments: Sequence[str],
    log_path: Path,
    progress: Callable[[dict[str, Any]], None],
    ended: Callable[[Sitting], None],
) -> Sitting:
    """Run ``r5dgs ARGUMENTS --progress json`` in a process of its own and wait for it.

    An exception on the way, such as KeyboardInterrupt, asks the process to keep its state and end, and goes on when it
    has.

    Args:
        arguments: Of the command line.
        log_path: What the process writes on stderr is added to this file; its folder must exist.
        progress: Called with each event that the process reports.
        ended: Called when the process has ended, also where an exception goes on.

    Returns:
        What it took.
    """
    root = str(Path(__file__).resolve().parents[2])
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-c", _CHILD, *arguments, "--progress", "json"]
    peaks: dict[str, Any] = {}
    began = time.monotonic()
    with open(log_path, "ab") as log:
        start = log.tell()
        # In a session of its own: Ctrl-C in the terminal reaches it through us, once.
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=log, text=True, env=environment, start_new_session=True
        )
    assert process.stdout is not None
    try:
        for event in map(_event, process.stdout):
            if event.get("event") == "peak":
                peaks = event
            elif event:
                progress(event)
    except BaseException:
        os.kill(process.pid, signal.SIGTERM)  # Popen's own would wait for it, and its time would be lost
        peaks = next((event for event in map(_event, process.stdout) if event.get("event") == "peak"), peaks)
        raise
    finally:
        sitting = _end(process, began, log_path, start, peaks)
        process.stdout.close()
        ended(sitting)
    return sitting


def tell_peak() -> None:
    """Print the largest memory of this process so far as an event."""
    event: dict[str, Any] = {"event": "peak", "peak_mb": _peak_mb(), "peak_gpu_mb": None}
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available() and torch.cuda.is_initialized():
        event["peak_gpu_mb"] = round(torch.cuda.max_memory_reserved() / 2**20, 1)
    print(json.dumps(event), flush=True)


def _peak_mb() -> float | None:
    """Largest resident memory of this process so far; None where the system does not tell."""
    try:
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return round(int(line.split()[1]) / 1024, 1)
    except (OSError, ValueError, IndexError):
        pass
    return None


def _event(line: str) -> dict[str, Any]:
    """An event that the process reported; empty for any other line."""
    try:
        event = json.loads(line)
    except ValueError:
        return {}
    return event if isinstance(event, dict) and "event" in event else {}


def _end(process: subprocess.Popen[str], began: float, log_path: Path, start: int, peaks: dict[str, Any]) -> Sitting:
    """Wait for the process and account for it."""
    cpu = None
    if hasattr(os, "wait4"):
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        cpu = usage.ru_utime + usage.ru_stime
    else:
        process.wait()
    with open(log_path, "rb") as log:
        log.seek(start)
        lines = log.read().decode(errors="replace").split("\n")
    complaint = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return Sitting(
        status=process.returncode,
        complaint=complaint.removeprefix("r5dgs: "),
        cpu_seconds=None if cpu is None else round(cpu, 3),
        wall_seconds=round(time.monotonic() - began, 3),
        peak_mb=peaks.get("peak_mb"),
        peak_gpu_mb=peaks.get("peak_gpu_mb"),
    )


def reason(sitting: Sitting) -> str:
    """Why a process that failed did, in one line."""
    if sitting.status < 0:
        name = signal.Signals(-sitting.status).name
        hint = "; the system may lack memory, --set densify.max_gaussians=N bounds it" if name == "SIGKILL" else ""
        return f"ended by {name}{hint}"
    return sitting.complaint or f"ended with status {sitting.status}"
