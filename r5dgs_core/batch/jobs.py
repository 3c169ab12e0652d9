"""Jobs of a batch: submission, repetition of crashed ones, and the result of all."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from .. import atomic_files, extras
from ..errors import BackendError, ConfigError, TrainingError
from . import table
from .captures import RESULT_FILE, TABLE_FILE

LIMIT_MIN = 7 * 24 * 60  # maximum duration of a local job by default, minutes; Slurm has limits of its own
POLL_S = 1.0


class Job(Protocol):
    """Interface of jobs; see `capture_job.CaptureJob`."""

    @property
    def capture(self) -> Any:
        """Return the capture, which has a ``name``."""
        ...

    @property
    def out(self) -> Path:
        """Return the output folder."""
        ...

    def __call__(self) -> dict[str, Any]:
        """Execute the job; return its ``evaluation``, or ``failure`` and ``repeat`` (True after a crash)."""
        ...

    def with_least_used_gpu(self, others: Sequence[Any]) -> Job:
        """Return the job with the GPU that the fewest other jobs have, if it may use several of them."""
        ...


Progress = Callable[[dict[str, Any]], None]


def executor(cluster: str, folder: Path, resources: dict[str, Any]) -> Any:
    """Return the executor of submitit for a cluster.

    Args:
        cluster: "local" or "slurm".
        folder: Folder for the files of the jobs.
        resources: Parameters of submitit.

    Raises:
        BackendError: submitit or Slurm is missing.
        ConfigError: A parameter is unknown or has a wrong type.
    """
    with extras.required("r5dgs batch", "cluster"):
        import submitit
    try:
        found = submitit.AutoExecutor(folder=folder, cluster=cluster)
    except RuntimeError as error:
        raise BackendError(f"--cluster {cluster}: {error}; remedy: run it on a login node of the cluster") from error
    usual = {"timeout_min": LIMIT_MIN} if cluster == "local" else {}
    try:
        found.update_parameters(name="r5dgs", **{**usual, **resources})
    except (NameError, TypeError, AssertionError, ValueError) as error:
        raise ConfigError(f"cluster: {' '.join(str(error).split())}") from error
    return found


def run(jobs: Sequence[Job], start: Any, *, at_once: int, retries: int, progress: Progress) -> dict[str, Any]:
    """Execute jobs, write the table after each of them, and return the content of `RESULT_FILE`.

    Args:
        jobs: Jobs of the same output folder.
        start: Executor, from `executor`.
        at_once: Maximum number of jobs that are submitted at the same time.
        retries: Number of repetitions of a job that was killed or has crashed.
        progress: Called with a dictionary per event.

    Raises:
        TrainingError: A capture failed; the others are finished and written.
        KeyboardInterrupt: The user stopped; the jobs are cancelled, and the same call continues.
    """
    waiting, tries = list(jobs), {job.capture.name: 0 for job in jobs}
    running: dict[str, tuple[Job, Any]] = {}
    queued: set[str] = set()
    evaluations: dict[str, Any] = {}
    failures: dict[str, str] = {}
    out = jobs[0].out
    result: dict[str, Any] = {}
    try:
        while waiting or running:
            while waiting and len(running) < at_once:
                job = waiting.pop(0).with_least_used_gpu([other for other, _ in running.values()])
                running[job.capture.name] = job, start.submit(job)
                queued.add(job.capture.name)
                progress({"event": "case", "text": f"{job.capture.name}: submitted"})
            time.sleep(POLL_S)
            for name, (job, submitted) in list(running.items()):
                if name in queued and submitted.paths.stdout.exists():  # created when the job starts
                    queued.remove(name)
                    progress({"event": "case", "text": f"{name}: running"})
                if not submitted.done():
                    continue
                del running[name]
                found = _result(submitted)
                reason = found.get("failure")
                if reason is None:
                    evaluations[name] = found["evaluation"]
                    progress({"event": "case", "text": f"{name}: finished"})
                elif found["repeat"] and tries[name] < retries:
                    tries[name] += 1
                    waiting.append(job)
                    progress({"event": "failed", "text": f"{name}: {reason}; it is tried again"})
                else:
                    failures[name] = reason
                    progress({"event": "failed", "text": f"{name}: {reason}"})
                result = _write(out, [j.capture.name for j in jobs], evaluations, failures)
    except BaseException:
        for _, submitted in running.values():
            submitted.cancel()
        raise
    if failures:
        raise _failed(failures, len(jobs), out)
    return result


def _failed(failures: dict[str, str], count: int, out: Path) -> TrainingError:
    """Return the error of a batch with failures."""
    name, reason = next(iter(failures.items()))
    return TrainingError(
        f"{len(failures)} of {count} captures failed, the first one {name}: {reason}; see {out / TABLE_FILE}, "
        "and repeat the same command to try them again"
    )


def _result(submitted: Any) -> dict[str, Any]:
    """Return what a job has returned, or the ``failure`` of a job that was killed or raised an error."""
    error = submitted.exception()
    if error is None:
        return submitted.result()
    lines = str(error).splitlines() or [type(error).__name__]
    raised = [line for line in lines if re.match(r"[\w.]+: ", line)]  # of a traceback
    silent = any("has not produced any output" in line for line in lines)  # of submitit
    reason = raised[-1] if raised else "the job ended without a result; it may have been killed" if silent else lines[0]
    return {"failure": f"{reason} (log: {submitted.paths.stderr})", "repeat": True}


def _write(out: Path, names: Sequence[str], evaluations: dict[str, Any], failures: dict[str, str]) -> dict[str, Any]:
    """Write the result and the table of the captures finished so far; returns the result."""
    result = {"captures": {n: evaluations[n] for n in names if n in evaluations}, "failures": failures}
    atomic_files.write(out / RESULT_FILE, json.dumps(result, indent=2).encode())
    atomic_files.write(out / TABLE_FILE, table.markdown(result).encode())
    return result
