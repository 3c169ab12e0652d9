"""Job queue of the worker: a Python with numba, started on first use and kept until the extension is unregistered.

There is one worker, and it runs one job at a time: a job holds the worker for all its steps, so that no other job
replaces its scene between loading and rendering. `run` blocks until the response arrives. `submit` returns a job for a
timer to poll; a new job replaces a waiting one with the same key. After the worker dies, the next job starts another.
No job thread accesses Blender's data.
"""

import atexit
import threading
import time
from typing import Any

import numpy as np

from ...r5dgs_core import errors
from .. import preferences
from .process import Worker

Steps = list[tuple[str, str, dict[str, Any]]]
Answer = tuple[dict[str, Any], dict[str, np.ndarray]]
SEARCHING = "looking for a Python with numba"


class Job:
    """Sequence of worker requests that runs in its own thread, so that Blender's UI stays responsive.

    Args:
        settings: Preferences that select the Python if no worker runs; the search for a Python runs in the thread, too.
        steps: Tuples of status text, command and arguments, executed in order.
        key: A later job with the same key replaces this one while it waits; "" for none.
    """

    def __init__(self, settings: preferences.Snapshot, steps: Steps, key: str = ""):
        self.key = key
        self.python = ""  # Python of the worker, once known
        self.dropped = False  # True if the job was dropped before it started
        self._step = "waiting for the worker"
        self._started = time.monotonic()
        self._answers: list[Answer] = []  # of the steps that have ended
        self._error: BaseException | None = None
        self._begun = self._ended = False
        self._ending = threading.Event()
        self._guard = threading.Lock()
        self._thread = threading.Thread(target=self._run, args=(settings, steps), name="r5dgs worker job", daemon=True)
        self._thread.start()

    @property
    def doing(self) -> str:
        """Short description of the current step."""
        return (notice() if self._begun else "") or self._step

    @property
    def done(self) -> bool:
        """True if `answer` returns without waiting."""
        return self.dropped or self._ended

    @property
    def seconds(self) -> float:
        """Seconds since the job was submitted."""
        return time.monotonic() - self._started

    def join(self) -> None:
        """Wait until the job has ended, successfully or not."""
        if not self.dropped:
            self._thread.join()

    def drop(self) -> bool:
        """Drop the job if it has not started. Returns True if it is dropped."""
        with self._guard:
            self.dropped = self.dropped or not self._begun
            return self.dropped

    def cancel(self) -> None:
        """Drop the job, or stop the worker if it has started: a render cannot be interrupted in another way."""
        if not self.drop():
            self._end()

    def answer(self) -> Answer:
        """Wait for the result and arrays of the last step. Re-raises its error; BackendError if the job was dropped."""
        return self.answers()[-1]

    def answers(self) -> list[Answer]:
        """Wait for the results and arrays of all steps. Raises as `answer` does."""
        self.join()
        preferences.keep_found()
        if self.dropped:
            raise errors.BackendError("worker: the job was dropped before it started")
        if self._error is not None:
            raise self._error
        return self._answers

    def _end(self) -> None:
        """Stop the worker until the job has ended. The job may just be starting one, or searching for its Python."""
        self._ending.set()
        while not self.done:
            _kill()
            self._thread.join(0.05)

    def _run(self, settings: preferences.Snapshot, steps: Steps) -> None:
        with _turn:
            with self._guard:
                if self.dropped:
                    return
                self._begun = True
            try:
                if settings.known() is None:
                    self._step = SEARCHING
                self.python = settings.python(self._ending.is_set)
                if self._ending.is_set():
                    raise errors.BackendError(
                        "worker: stopped during the search for a Python; the next request searches again"
                    )
                self._step = "starting the worker"
                running = _running(self.python)
                running.greet(settings.timeout_s)
                for self._step, command, arguments in steps:
                    self._answers.append(running.request(command, settings.timeout_s, **arguments))
            except BaseException as error:  # re-raised by `answer`
                self._error = error
            finally:  # set before the lock is released, because the thread itself may take a moment longer
                self._ended = True


_turn = threading.Lock()  # held by the job that uses the worker
_state = threading.Lock()  # held while the globals below change
_worker: Worker | None = None
_jobs: list[Job] = []


def submit(key: str, steps: Steps) -> Job:
    """Start a `Job` and drop waiting jobs with the same key: the latest request wins.

    Returns immediately, as the search for a Python is part of the job. Call it from Blender's main thread, and poll the
    job's ``done`` from a timer.

    Args:
        key: Name of the requester, for example "viewport".
        steps: As for `Job`.

    Returns:
        The job.
    """
    for job in _waiting(key):
        job.drop()
    job = Job(preferences.snapshot(), steps, key)
    with _state:
        _jobs[:] = [other for other in _jobs if not other.done] + [job]
    return job


def start(steps: Steps) -> Job:
    """`submit` a job that no later job replaces."""
    return submit("", steps)


def run(steps: Steps) -> Answer:
    """Run steps in order and wait for them. Returns the result and arrays of the last step.

    Raises:
        R5dgsError: Error reported by the worker, or BackendError if it is unavailable.
    """
    return start(steps).answer()


def request(command: str, **arguments: Any) -> Answer:
    """`run` of one step."""
    return run([("waiting for an answer", command, arguments)])


def current(python: str | None = None) -> Worker:
    """Return the running worker after its handshake; starts one if none runs or if another Python is requested.

    Raises:
        BackendError: The worker cannot be started.
    """
    settings = preferences.snapshot()
    python = python or preferences.worker_python()
    with _turn:
        running = _running(python)
        running.greet(settings.timeout_s)
        return running


def notice() -> str:
    """Return the reason why renders of the running worker are delayed (compilation), or ""."""
    running = _worker
    return running.notice if running is not None and running.alive else ""


def formats() -> frozenset[str] | None:
    """Names of the export formats that the running worker can write, or None if none has answered yet."""
    running = _worker
    known = running.hello.get("formats") if running is not None and running.alive else None
    return None if known is None else frozenset(known)


def simulates() -> bool | None:
    """True if the running worker can simulate contacts, or None if none has answered yet."""
    running = _worker
    return running.hello.get("contact") if running is not None and running.alive else None


def busy(key: str | None = None) -> bool:
    """True if any job with this key, or any job at all if None, has not ended."""
    return any(not job.done and (key is None or job.key == key) for job in list(_jobs))


def stop() -> None:
    """Stop the worker if one runs. Waiting jobs end with an error."""
    jobs = list(_jobs)
    for job in jobs:
        job.drop()
    for job in jobs:
        job._end()
    _kill()


def _waiting(key: str) -> list[Job]:
    return [job for job in list(_jobs) if key and job.key == key and not job.done]


def _running(python: str) -> Worker:
    """Return the worker for a Python, replacing a dead or different one. The caller holds ``_turn``."""
    global _worker
    if _worker is not None and (not _worker.alive or _worker.python != python):
        _kill()
    if _worker is None:
        _worker = Worker(python)
    return _worker


def _kill() -> None:
    global _worker
    with _state:
        worker, _worker = _worker, None
    if worker is not None:
        worker.close()


def register():
    """Ensure that no worker outlives Blender."""
    atexit.register(stop)


def unregister():
    """Stop the worker."""
    atexit.unregister(stop)
    stop()
