"""The add-on's side of the worker: a Python with torch, started when it is first needed, kept until the add-on ends.

There is one worker, and it does one thing after the other: whoever asks has it for all steps of what is asked, so that
nobody's scenes are exchanged between loading and rendering. `run` waits for the answer; `submit` returns a job that a
timer looks at, and what waits under the same key is dropped for what comes later. After a worker's death the next
request starts another. No thread touches Blender's data.
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
SEARCHING = "looking for a Python with torch"


class Job:
    """Requests that wait for their answers in a thread of their own, so that Blender's window stays free.

    Args:
        choice: Which Python the worker has that is started where none runs; it is searched for in the thread, too.
        steps: What the sidebar says while it waits, the command, and its arguments; one after the other.
        key: What a later job takes the place of this one by; "" for nothing.
    """

    def __init__(self, choice: preferences.Choice, steps: Steps, key: str = ""):
        self.key = key
        self.python = ""  # the worker's, once it is known
        self.dropped = False  # whether it ended before it began
        self._step = "waiting for the worker"
        self._started = time.monotonic()
        self._answer: Answer | None = None
        self._error: BaseException | None = None
        self._begun = self._ended = False
        self._ending = threading.Event()
        self._guard = threading.Lock()
        self._thread = threading.Thread(target=self._run, args=(choice, steps), name="r5dgs worker job", daemon=True)
        self._thread.start()

    @property
    def doing(self) -> str:
        """What it waits for, in a few words."""
        return (notice() if self._begun else "") or self._step

    @property
    def done(self) -> bool:
        """Whether `answer` returns at once."""
        return self.dropped or self._ended

    @property
    def seconds(self) -> float:
        """Seconds since it was asked for."""
        return time.monotonic() - self._started

    def join(self) -> None:
        """Wait until it has ended, whatever came of it."""
        if not self.dropped:
            self._thread.join()

    def drop(self) -> bool:
        """Have it not begin. Returns whether that was in time."""
        with self._guard:
            self.dropped = self.dropped or not self._begun
            return self.dropped

    def cancel(self) -> None:
        """Have it not begin, or end it by stopping the worker, which has no other way to leave a picture unfinished."""
        if not self.drop():
            self._end()

    def answer(self) -> Answer:
        """Wait for the last step's result and arrays. Raises what a step raised, BackendError where it was dropped."""
        self.join()
        preferences.keep_found()
        if self.dropped:
            raise errors.BackendError("worker: what was asked for was taken back before its turn")
        if self._error is not None:
            raise self._error
        assert self._answer is not None
        return self._answer

    def _end(self) -> None:
        """Stop the worker until the job has ended; it may be starting one just now, or looking for its Python."""
        self._ending.set()
        while not self.done:
            _kill()
            self._thread.join(0.05)

    def _run(self, choice: preferences.Choice, steps: Steps) -> None:
        with _turn:
            with self._guard:
                if self.dropped:
                    return
                self._begun = True
            try:
                if choice.known() is None:
                    self._step = SEARCHING
                self.python = choice.python(self._ending.is_set)
                if self._ending.is_set():
                    raise errors.BackendError(
                        "worker: stopped while its Python was looked for; the next request looks again"
                    )
                self._step = "starting the worker"
                running = _running(self.python)
                running.greet(choice.timeout_s)
                for self._step, command, arguments in steps:
                    self._answer = running.request(command, choice.timeout_s, **arguments)
            except BaseException as error:  # raised again where the answer is asked for
                self._error = error
            finally:  # before the next one's turn: the thread itself may take a moment more
                self._ended = True


_turn = threading.Lock()  # held by who asks the worker
_state = threading.Lock()  # held while the names below change
_worker: Worker | None = None
_jobs: list[Job] = []


def submit(key: str, steps: Steps) -> Job:
    """Begin a `Job`; what waits under the same key and has not begun is dropped: the latest request wins.

    It returns at once: even the search for a Python is the job's. Call it from Blender's main thread, and look at the
    job's ``done`` from a timer.

    Args:
        key: Who asks, "viewport" for example.
        steps: As for `Job`.

    Returns:
        The job.
    """
    for job in _waiting(key):
        job.drop()
    job = Job(preferences.choice(), steps, key)
    with _state:
        _jobs[:] = [other for other in _jobs if not other.done] + [job]
    return job


def start(steps: Steps) -> Job:
    """`submit` of something whose place nothing takes."""
    return submit("", steps)


def run(steps: Steps) -> Answer:
    """Ask for steps one after the other and wait, for the turn, too; the last one's result and arrays.

    Raises:
        R5dgsError: What the worker reports, or why it cannot be asked.
    """
    return start(steps).answer()


def request(command: str, **arguments: Any) -> Answer:
    """`run` of one step."""
    return run([("waiting for an answer", command, arguments)])


def current(python: str | None = None) -> Worker:
    """The running worker, greeted; it is started where none runs or another Python is wanted.

    Raises:
        BackendError: It cannot be started.
    """
    choice = preferences.choice()
    python = python or preferences.worker_python()
    with _turn:
        running = _running(python)
        running.greet(choice.timeout_s)
        return running


def notice() -> str:
    """What pictures of the running worker wait for at present beside their own making; else empty."""
    running = _worker
    return running.notice if running is not None and running.alive else ""


def busy(key: str | None = None) -> bool:
    """Whether a job has not ended yet: one of a key, or any."""
    return any(not job.done and (key is None or job.key == key) for job in list(_jobs))


def stop() -> None:
    """Stop the worker, if one runs; jobs that wait for it end with an error."""
    jobs = list(_jobs)
    for job in jobs:
        job.drop()
    for job in jobs:
        job._end()
    _kill()


def _waiting(key: str) -> list[Job]:
    return [job for job in list(_jobs) if key and job.key == key and not job.done]


def _running(python: str) -> Worker:
    """The worker of a Python, for who has the turn."""
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
    """See to it that no worker outlives Blender."""
    atexit.register(stop)


def unregister():
    """Stop the worker."""
    atexit.unregister(stop)
    stop()
