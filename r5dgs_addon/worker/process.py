"""Worker process and its protocol.

The protocol is that of `r5dgs_core.worker.server`: one JSON line each way; a response line announces raw bytes, which
follow it. Lines without a request id report the start and end of kernel compilation. A worker that dies, times out or
sends invalid data is stopped with a clear error.

The Python may be a wrapper script whose child does the work and keeps the pipes open. Therefore the whole process
group is ended, and each pipe is closed only by the thread that uses it: closing it elsewhere would block on that
thread's lock.
"""

import base64
import collections
import contextlib
import json
import logging
import math
import os
import queue
import signal
import subprocess
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.protocol import answers
from .. import find_python, preferences
from ..process_group import ProcessGroup

if TYPE_CHECKING:
    from ..scene import evaluated_points

ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENT = preferences.ENVIRONMENT
STDERR_LINES = 12
COMPILE_PATIENCE = 10  # timeouts to wait while kernels are compiled, which takes minutes on a busy machine
LAST_WORDS_S = 0.5  # time to read the rest of the pipes after a worker's death
REMEDY = f"set 'Worker Python' in the extension's preferences, or {ENVIRONMENT}, to a Python with numba"
COMPILING = "preparing the rasterizer (first use, 10 to 30 s)"

log = logging.getLogger(__name__)


class Worker:
    """Running worker process. Call `greet` before the first request.

    Args:
        python: Path of the Python executable.

    Raises:
        BackendError: The process cannot be started.
    """

    def __init__(self, python: str):
        self.python = python
        self.hello: dict[str, Any] = {}
        self.notice = ""  # reason why renders are delayed, or ""
        self._heard = -math.inf  # time of the last event, which restarts the wait for an answer
        self._held: set[str] = set()  # keys of the point edits that the worker has cached
        self._number = 0
        self._answers: queue.Queue = queue.Queue()
        self._stderr: collections.deque[str] = collections.deque(maxlen=STDERR_LINES)
        environment = find_python.environment(python)
        if find_python.is_own(python) and (kernels := preferences.snapshot().kernels):
            environment.setdefault("NUMBA_CACHE_DIR", kernels)
        known = environment.get("PYTHONPATH", "")
        # The extension's own copy of the core comes first, so that both sides have the same version.
        environment["PYTHONPATH"] = str(ROOT) + (os.pathsep + known if known else "")
        environment["PYTHONUNBUFFERED"] = "1"
        try:
            self._group = ProcessGroup(
                [python, "-m", "r5dgs_core.worker.server"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env=environment,
                cwd=str(ROOT),
            )
        except OSError as error:
            raise errors.BackendError(
                f"worker: '{python}' cannot be started ({error.strerror or error}); {REMEDY}"
            ) from error
        self._process = self._group.process
        self._writing = threading.Lock()
        self._readers = [
            threading.Thread(target=self._read_answers, name="r5dgs worker answers", daemon=True),
            threading.Thread(target=self._read_stderr, name="r5dgs worker log", daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    def greet(self, timeout_s: float) -> None:
        """Perform the handshake, once.

        Args:
            timeout_s: Seconds to wait before the worker is stopped.

        Raises:
            BackendError: The worker does not respond, or its Python lacks required packages.
        """
        if self.hello:
            return
        try:
            self.hello, _ = self.request("hello", timeout_s)
            if self.hello.get("missing"):
                raise errors.BackendError(
                    f"worker: {self.python} lacks {', '.join(self.hello['missing'])}; install the core there "
                    "('pip install r5dgs') or choose another 'Worker Python' in the extension's preferences"
                )
        except BaseException:
            self.close()
            raise

    @property
    def alive(self) -> bool:
        """True while the process runs."""
        return self._group.alive

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def request(self, command: str, timeout_s: float, **arguments: Any) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Send a request and wait for the response.

        Args:
            command: Name of the request.
            timeout_s: Seconds to wait before the worker is stopped, counted from the end of the compilation of kernels.
            **arguments: JSON-compatible arguments. For the command ``points``, ``points`` is a tuple of
                `evaluated_points.Edit`; edits that the worker has cached are not sent again.

        Returns:
            Result and arrays by name.

        Raises:
            R5dgsError: Error reported by the worker, with its original class.
            BackendError: The worker died or did not respond in time.
        """
        if command == "points":
            arguments = self._hand_over(arguments["points"])
        self._number += 1
        line = json.dumps({"id": self._number, "command": command, **arguments}, allow_nan=False) + "\n"
        try:
            assert self._process.stdin is not None
            with self._writing, _broken_pipes_are_errors():
                self._process.stdin.write(line.encode())
                self._process.stdin.flush()
        except (OSError, ValueError):
            raise self._death() from None
        waited = 0.0
        while True:
            try:
                answer = self._answers.get(timeout=timeout_s)
            except queue.Empty:
                waited += timeout_s
                compiles = self.notice or time.monotonic() - self._heard < timeout_s
                if compiles and waited < COMPILE_PATIENCE * timeout_s:
                    continue
                self.close()
                raise errors.BackendError(
                    f"worker: no answer to '{command}' within {timeout_s:g} s, so it was stopped; try again, or raise "
                    "'Timeout' in the extension's preferences"
                ) from None
            if answer is None:
                raise self._death()
            header, arrays = answer
            if header.get("id") == self._number:
                break
        if not header.get("ok"):
            raise _error_of(header)
        if command == "points":
            self._held = set(arguments["keep"])
        return header.get("result", {}), arrays

    def close(self) -> None:
        """End the process group. A caller that waits for a response gets a BackendError.

        Returns within two seconds, even if a process has left the group and keeps the pipes open; that process receives
        the end of its input.
        """
        self._group.end()
        if self._writing.acquire(blocking=False):  # else the writing thread fails and closes the pipe
            try:
                with contextlib.suppress(OSError), _broken_pipes_are_errors():
                    assert self._process.stdin is not None
                    self._process.stdin.close()
            finally:
                self._writing.release()
        self._answers.put(None)

    def _hand_over(self, edits: Iterable["evaluated_points.Edit"]) -> dict[str, Any]:
        """Return the arguments of a ``points`` request."""
        new = {
            edit.key: {name: base64.b64encode(values.data).decode() for name, values in edit.arrays().items()}
            for edit in edits
            if edit.key not in self._held
        }
        return {"keep": [edit.key for edit in edits], "new": new}

    def _death(self) -> errors.BackendError:
        self.close()
        for reader in self._readers:
            reader.join(timeout=LAST_WORDS_S)
        code = self._process.returncode or 0
        # A shell returns 128 + signal if a signal ended its child; stderr then does not explain the exit.
        killed = not {-code, code - 128}.isdisjoint((signal.SIGTERM, getattr(signal, "SIGKILL", None)))
        said = "" if killed else " | ".join(line for line in list(self._stderr)[-4:] if line.strip())
        why = "stopped from outside; perhaps memory ran out" if killed else f"exit code {code}"
        return errors.BackendError(
            f"worker: {self.python} ended unexpectedly ({why})"
            + (f": {said}" if said else "")
            + ("; the next request starts it again" if self.hello else f" before it answered; {REMEDY}")
        )

    def _read_answers(self) -> None:
        stream = self._process.stdout
        assert stream is not None
        try:
            self._read_from(stream)
        except (OSError, ValueError, KeyError, TypeError) as error:
            self._stderr.append(f"unreadable answer: {error}")
        finally:
            self._answers.put(None)
            stream.close()

    def _read_from(self, stream: IO[bytes]) -> None:
        while line := stream.readline():
            header = json.loads(line)
            if "event" in header:
                self._handle_event(header)
                continue
            arrays = answers.read_arrays(stream, header)
            if arrays is None:
                return
            self._answers.put((header, arrays))

    def _handle_event(self, event: dict[str, Any]) -> None:
        self._heard = time.monotonic()
        notice = COMPILING if event["event"] in ("compiling", "progress") else ""
        if event["event"] == "progress":
            notice += f", step {event['step']:d} of {event['steps']:d}"
        if event["event"] == "compiling":
            log.warning("R5DGS worker: %s", notice)
        if event["event"] == "failed":
            log.warning("R5DGS worker: the rasterizer could not be prepared: %s", event.get("text", "no reason given"))
        self.notice = notice  # set last: a reader that sees the notice can rely on the log entry

    def _read_stderr(self) -> None:
        stream = self._process.stderr
        assert stream is not None
        with stream, contextlib.suppress(OSError, ValueError):
            for line in stream:
                self._stderr.append(line.decode(errors="replace").rstrip())


@contextlib.contextmanager
def _broken_pipes_are_errors() -> Iterator[None]:
    """Turn SIGPIPE into BrokenPipeError in this thread.

    Unlike Python, Blender keeps the default action of SIGPIPE, which ends the process.
    """
    if not hasattr(signal, "SIGPIPE"):  # Windows has no SIGPIPE
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGPIPE})
    try:
        yield
    finally:
        if signal.SIGPIPE not in before:
            while signal.SIGPIPE in signal.sigpending():
                signal.sigwait({signal.SIGPIPE})
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _error_of(header: dict[str, Any]) -> errors.R5dgsError:
    """Convert an error response to the class of `errors` that it names, or BackendError."""
    report = header.get("error", {})
    kind = getattr(errors, str(report.get("kind")), None)
    message = str(report.get("message", "no reason given"))
    if isinstance(kind, type) and issubclass(kind, errors.R5dgsError):
        return kind(message)
    return errors.BackendError(f"worker: {report.get('kind', 'error')}: {message}")
