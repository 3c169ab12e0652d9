"""Child process that is terminated together with its descendants.

A wrapper script (``conda run``, a module system, a shell script) runs the real program as its own child, which
outlives the wrapper if only that is killed. On POSIX, the wrapper leads a process group in its own session. On
Windows, it belongs to a job object, which the system also terminates when Blender exits.
"""

import contextlib
import ctypes
import os
import signal
import subprocess
import threading
import time
from typing import Any

GRACE_S = 0.5  # time between SIGTERM and SIGKILL
GONE_S = 1.0  # a killed process takes longer only inside an uninterruptible system call
_POLL_S = 0.01


class ProcessGroup:
    """Running process and its descendants. Safe to use from any thread.

    Args:
        arguments: Program and arguments.
        options: As for `subprocess.Popen`.

    Raises:
        OSError: The program cannot be started.
    """

    def __init__(self, arguments: list[str], **options: Any):
        if os.name == "nt":
            options["creationflags"] = getattr(subprocess, "CREATE_NO_WINDOW", 0)
        else:
            options["start_new_session"] = True
        self.process = subprocess.Popen(arguments, **options)
        self._job = _Job(self.process) if os.name == "nt" else None
        self._guard = threading.Lock()
        self._ended = False

    @property
    def alive(self) -> bool:
        """True while the first process runs."""
        if not hasattr(os, "waitid"):  # no os.waitid on Windows and on macOS before Python 3.13
            return self.process.poll() is None
        # Only `end` collects the exit status: until then, the system does not reuse the process group id.
        with contextlib.suppress(ChildProcessError):
            options = os.WEXITED | os.WNOHANG | os.WNOWAIT
            return self.process.returncode is None and os.waitid(os.P_PID, self.process.pid, options) is None
        return False

    def end(self) -> None:
        """End all processes within `GRACE_S` + `GONE_S` seconds, including those that ignore SIGTERM."""
        with self._guard:
            if self._ended:
                return
            if self._job is not None:
                self._job.end()
            else:
                self._signal("SIGTERM")
                deadline = time.monotonic() + GRACE_S
                while self.alive and time.monotonic() < deadline:
                    time.sleep(_POLL_S)
                self._signal("SIGKILL")
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(timeout=GONE_S)
            self._ended = True

    def _signal(self, name: str) -> None:
        with contextlib.suppress(ProcessLookupError, PermissionError):  # no process left, or on macOS only zombies
            os.killpg(self.process.pid, getattr(signal, name))


class _Limits(ctypes.Structure):
    """``JOBOBJECT_EXTENDED_LIMIT_INFORMATION``."""

    _fields_ = (
        ("times", ctypes.c_int64 * 2),
        ("flags", ctypes.c_uint32),
        ("working_set", ctypes.c_size_t * 2),
        ("active_processes", ctypes.c_uint32),
        ("affinity", ctypes.c_size_t),
        ("priority_and_scheduling", ctypes.c_uint32 * 2),
        ("io_counters", ctypes.c_uint64 * 6),
        ("memory", ctypes.c_size_t * 4),
    )


class _Job:
    """Windows job object: a process and everything that it starts from now on.

    Args:
        process: Process that was just started.
    """

    _EXTENDED_LIMITS, _KILL_ON_CLOSE = 9, 0x2000

    def __init__(self, process: subprocess.Popen):
        self._process = process
        self._kernel: Any = getattr(ctypes, "WinDLL")("kernel32")  # noqa: B009  (known to pyright on Windows only)
        self._kernel.CreateJobObjectW.restype = ctypes.c_void_p
        self._handle = ctypes.c_void_p(self._kernel.CreateJobObjectW(None, None))
        limits = _Limits(flags=self._KILL_ON_CLOSE)
        size = ctypes.sizeof(limits)
        self._kernel.SetInformationJobObject(self._handle, self._EXTENDED_LIMITS, ctypes.byref(limits), size)
        child = ctypes.c_void_p(int(getattr(process, "_handle")))  # noqa: B009
        self._holds = bool(self._kernel.AssignProcessToJobObject(self._handle, child))

    def end(self) -> None:
        """Terminate all processes of the job, or only the first one if the system refused to assign it to the job."""
        if self._holds:
            self._kernel.TerminateJobObject(self._handle, 1)
        else:
            self._process.kill()
        self._kernel.CloseHandle(self._handle)
