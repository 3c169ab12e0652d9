"""Commands of ``r5dgs`` in separate processes, so that their processor time and memory can be measured."""

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

# The operating system's peak size of a forked process includes its parent's, so the child reports its own.
_CHILD = """
import sys
from r5dgs_core.cli import main as cli
from r5dgs_core.bench import process
try:
    status = cli.main(sys.argv[1:])
finally:
    process.print_peak()
sys.exit(status)
"""
STOPPED = 130
REFUSED = (2, 3)  # statuses of errors that the user can resolve (docs/reference/command_line.md)


@dataclass(frozen=True)
class EndedProcess:
    """Status and cost of a process that has ended.

    Attributes:
        status: Exit status; negative for the signal that ended it.
        complaint: Last line on stderr; "" without one.
        cpu_seconds: Processor time of all threads, including start and end of Python; None if unknown.
        wall_seconds: Wall time from start to end.
        peak_mb: Peak resident memory, MiB; None if unknown.
        peak_gpu_mb: Peak GPU memory reserved by torch, MiB; None if no GPU was used.
    """

    status: int
    complaint: str
    cpu_seconds: float | None
    wall_seconds: float
    peak_mb: float | None
    peak_gpu_mb: float | None


def run(
    arguments: Sequence[str],
    log_path: Path,
    progress: Callable[[dict[str, Any]], None],
    ended: Callable[[EndedProcess], None],
) -> EndedProcess:
    """Run ``r5dgs ARGUMENTS --progress json`` in a separate process and wait for it.

    On an exception, such as KeyboardInterrupt, the process gets SIGTERM, saves its state and ends; the exception is
    then raised again.

    Args:
        arguments: Arguments of the command line.
        log_path: File to which stderr of the process is appended; its folder must exist.
        progress: Called with each event of the process.
        ended: Called when the process has ended, also after an exception.

    Returns:
        Status and cost of the process.
    """
    root = str(Path(__file__).resolve().parents[2])
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-c", _CHILD, *arguments, "--progress", "json"]
    peaks: dict[str, Any] = {}
    began = time.monotonic()
    with open(log_path, "ab") as log:
        start = log.tell()
        # A separate session: Ctrl-C in the terminal reaches the process only once, through us.
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
        os.kill(process.pid, signal.SIGTERM)  # Popen.terminate() may reap the process and lose its resource usage
        peaks = next((event for event in map(_event, process.stdout) if event.get("event") == "peak"), peaks)
        raise
    finally:
        result = _end(process, began, log_path, start, peaks)
        process.stdout.close()
        ended(result)
    return result


def print_peak() -> None:
    """Print the peak memory of this process as an event."""
    event: dict[str, Any] = {"event": "peak", "peak_mb": _peak_mb(), "peak_gpu_mb": None}
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available() and torch.cuda.is_initialized():
        event["peak_gpu_mb"] = round(torch.cuda.max_memory_reserved() / 2**20, 1)
    print(json.dumps(event), flush=True)


def _peak_mb() -> float | None:
    """Return the peak resident memory of this process, MiB; None if the system does not report it."""
    try:
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return round(int(line.split()[1]) / 1024, 1)
    except (OSError, ValueError, IndexError):
        pass
    return None


def _event(line: str) -> dict[str, Any]:
    """Parse an event of the process; returns an empty dict for any other line."""
    try:
        event = json.loads(line)
    except ValueError:
        return {}
    return event if isinstance(event, dict) and "event" in event else {}


def _end(
    process: subprocess.Popen[str], began: float, log_path: Path, start: int, peaks: dict[str, Any]
) -> EndedProcess:
    """Wait for the process and return its status and cost."""
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
    return EndedProcess(
        status=process.returncode,
        complaint=complaint.removeprefix("r5dgs: "),
        cpu_seconds=None if cpu is None else round(cpu, 3),
        wall_seconds=round(time.monotonic() - began, 3),
        peak_mb=peaks.get("peak_mb"),
        peak_gpu_mb=peaks.get("peak_gpu_mb"),
    )


def reason(result: EndedProcess) -> str:
    """Return the reason why a process failed, in one line."""
    if result.status < 0:
        name = signal.Signals(-result.status).name
        hint = "; possibly out of memory, which --set densify.max_gaussians=N limits" if name == "SIGKILL" else ""
        return f"ended by {name}{hint}"
    return result.complaint or f"ended with status {result.status}"
