"""How the kernels of the `cpu` backend are compiled, cached and run on several threads.

A kernel is a function ``kernel(worker, workers, ...)`` that does its share of the work and releases the interpreter
lock. Plain Python threads run the shares: compiling takes a fraction of what numba's own parallel loops take, calls
from several threads at once are safe, and results cannot depend on a threading layer.

What one process compiles the next one loads. The first compilation of a process is told by a warning, or as `telling`
says.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import logging
import os
import re
import shutil
import stat
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numba
from numba.core import event as numba_events

log = logging.getLogger(__name__)

NOTICE = "rasterizer: compiling its kernels for this machine, once; 10 to 30 s"
NOTICE_UNKEPT = "rasterizer: compiling its kernels, as there is no place to keep them; 10 to 30 s in every process"

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_INNER: dict[str, Any] = {"no_cpython_wrapper": True}

_SHARED = ("raster/**/*.py", "scene/sh_color.py", "scene/spherical_harmonics.py")  # helpers and frozen constants
_OURS = re.compile("r5dgs-[0-9a-f]{12}")
_KEPT_S = 28 * 24 * 3600.0
_SYSTEM_USERS = (0, 65534)  # root, and what root's files belong to inside a container of the user

_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_threads = max(1, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


def kernel(function) -> Any:
    """Compile at the first call, without the interpreter lock, and keep the machine code for the next process.

    The machine code belongs to the state of the file that defines ``function`` and of `shared_sources`: a kernel
    outside this package may freeze constants and call helpers of these files alone.
    """
    with _lock:
        before = numba.config.CACHE_DIR  # type: ignore[attr-defined]
        folder = _cache_folder(before)
        own = None if folder is None else os.path.join(folder, _digest([Path(function.__code__.co_filename)]))
        numba.config.CACHE_DIR = own or before  # type: ignore[attr-defined]
        try:
            compiled = numba.njit(cache=own is not None, **_OPTIONS)(function)
            _watch.kernels.add(compiled)
            return compiled
        finally:
            numba.config.CACHE_DIR = before  # type: ignore[attr-defined]


def helper(function) -> Any:
    """Compile for use inside kernels alone: becomes part of their machine code, and costs no time of its own.

    Never call one from Python: it has no wrapper that unpacks Python's objects, and the interpreter would crash.
    """
    return numba.njit(**_OPTIONS, **_INNER)(function)


class _Watch(numba_events.Listener):
    """Sees every compilation in this process, one at a time under numba's own lock; what is loaded passes unseen.

    The garbage collector rests meanwhile: again and again it would look through all that the compiler holds, which is
    a twelfth of the time.
    """

    def __init__(self) -> None:
        self.kernels: weakref.WeakSet = weakref.WeakSet()
        self.compiled = 0
        self.tell: Callable[[str], object] = log.warning
        self._depth = 0  # of a kernel, and of the helpers in it
        self._collects = False

    def on_start(self, event) -> None:
        if not self._depth and event.data["dispatcher"] not in self.kernels:
            return
        self._depth += 1
        if self._depth > 1:
            return
        self._collects = gc.isenabled()
        gc.disable()
        self.compiled += 1
        if self.compiled == 1:
            self.tell(NOTICE if cache_folder() else NOTICE_UNKEPT)

    def on_end(self, event) -> None:
        if self._depth == 1 and self._collects:
            gc.enable()
        self._depth = max(0, self._depth - 1)


_watch = _Watch()
numba_events.register("numba:compile", _watch)


def compiled() -> int:
    """Number of kernels that this process had to compile so far, as no earlier one did."""
    return _watch.compiled


@contextlib.contextmanager
def telling(tell: Callable[[str], object]) -> Iterator[None]:
    """Tell of the process's first compilation by ``tell(text)`` instead of a warning in the log; from any thread."""
    before, _watch.tell = _watch.tell, tell
    try:
        yield
    finally:
        _watch.tell = before


def cache_folder() -> Path | None:
    """Where the machine code of this version is kept; None where no place can be written."""
    folder = _cache_folder(numba.config.CACHE_DIR)  # type: ignore[attr-defined]
    return None if folder is None else Path(folder)


def set_threads(count: int) -> None:
    """Number of threads that `run` uses from now on; at first NUMBA_NUM_THREADS, or the usable cores."""
    global _pool, _threads
    if count < 1:
        raise ValueError(f"threads: expected at least 1, got {count}")
    with _lock:
        _pool, _threads = None, count  # the old threads end by themselves once nobody uses them


def threads() -> int:
    """Number of threads that `run` uses."""
    return _threads


def run(function, work: int, *arguments) -> None:
    """Call ``function(worker, workers, *arguments)`` for all workers at once and wait for them.

    Args:
        function: A `kernel`; what it computes must not depend on ``workers``.
        work: Independent pieces of work that are worth a thread; fewer than two run on this thread alone.
        arguments: Passed on.
    """
    run_parts(function, min(_threads, work), *arguments)


def run_parts(function, parts: int, *arguments) -> None:
    """Call ``function(part, parts, *arguments)`` for every part, on as many threads as there are, and wait for them.

    For kernels whose parts belong together over several calls; others let `run` choose the number.
    """
    if parts < 2:
        function(0, 1, *arguments)
        return
    pool = _get_pool()
    others = [pool.submit(function, part, parts, *arguments) for part in range(1, parts)]
    try:
        function(0, parts, *arguments)
    finally:  # the arrays must outlive every share, whatever happened to ours
        for other in others:
            other.result()


def _get_pool() -> ThreadPoolExecutor:
    global _pool
    with _lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(max(1, _threads - 1), "r5dgs-raster")
        return _pool


def _forget_pool() -> None:
    """A forked child has no threads: let it make its own."""
    global _lock, _pool
    _lock, _pool = threading.Lock(), None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pool)


@functools.cache
def _cache_folder(chosen: str) -> str | None:
    """Folder for machine code, apart for each state of the shared sources; None if no place can be written.

    Numba looks only at time and size of the file of the compiled function, not at the files of the functions it calls
    and of the constants that it freezes, hence the digest.
    """
    digest = _digest(shared_sources())
    tried = []
    for base in _bases(chosen):
        folder = base / f"r5dgs-{digest}"
        is_new = not folder.exists()
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            danger = _danger(folder)
            if danger is None:
                tempfile.TemporaryFile(dir=folder).close()
        except OSError as error:
            tried.append(f"{base} ({error.strerror})")
            continue
        if danger is not None:  # machine code that others can replace is not loaded
            log.warning("rasterizer: no compiled code is kept in %s, as %s; remedy: remove it", folder, danger)
            tried.append(f"{base} (others can write there)")
            continue
        with contextlib.suppress(OSError):
            os.utime(folder)  # it is in use
        if is_new:
            _remove_old(base)
        return str(folder)
    log.warning(
        "rasterizer: no place to keep compiled code, so every process compiles again; tried %s; "
        "remedy: set NUMBA_CACHE_DIR to a folder that can be written",
        ", ".join(tried) or "none",
    )
    return None


def _danger(folder: Path) -> str | None:
    """Return a reason why others than the user can put code into a folder, or None if only the user can."""
    if not hasattr(os, "getuid"):  # Windows: folders inherit the rights of the user's profile
        return None
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
        return "it is a link or belongs to another user"
    if status.st_mode & 0o022:
        return "others can write there"
    for parent in folder.resolve().parents:  # whoever can rename a folder can put another one into its place
        status = parent.stat()
        if status.st_uid not in (os.getuid(), *_SYSTEM_USERS):
            return f"{parent} belongs to another user"
        if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
            return f"others can write in {parent}"
    return None


def shared_sources() -> list[Path]:
    """Files that the machine code of any kernel may be made of, beside its own: helpers and frozen constants."""
    core = Path(__file__).parents[2]
    return sorted(path for pattern in _SHARED for path in core.glob(pattern))


def _digest(sources: Iterable[Path]) -> str:
    """First 12 hexadecimal digits of the SHA-256 of files."""
    digest = hashlib.sha256()
    for source in sources:
        digest.update(source.read_bytes())
    return digest.hexdigest()[:12]


def _remove_old(base: Path) -> None:
    """Remove machine code of other versions that no process has used for weeks; what cannot be removed stays."""
    for folder in base.glob("r5dgs-*"):
        with contextlib.suppress(OSError):
            status = folder.lstat()
            unused_s = time.time() - status.st_mtime
            if _OURS.fullmatch(folder.name) and stat.S_ISDIR(status.st_mode) and unused_s > _KEPT_S:
                shutil.rmtree(folder, ignore_errors=True)


def _bases(chosen: str) -> Iterator[Path]:
    """Places for machine code, best first: the user's choice, the user's cache, an own temporary folder."""
    if chosen:
        yield Path(chosen)
    user_cache = _user_cache()
    if user_cache is not None:
        yield user_cache
    temporary = _own_temporary()
    if temporary is not None:
        yield temporary


def _user_cache() -> Path | None:
    try:
        if sys.platform == "win32":
            base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
        elif sys.platform == "darwin":
            base = Path.home() / "Library" / "Caches"
        else:
            base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:  # no HOME, and the user is in no table
        return None
    return Path(base) / "r5dgs" / "numba"


def _own_temporary() -> Path | None:
    """A folder of this user alone: machine code that others could replace is not loaded."""
    try:
        if not hasattr(os, "getuid"):  # Windows: the temporary folder is the user's
            return Path(tempfile.gettempdir()) / "r5dgs"
        folder = Path(tempfile.gettempdir()) / f"r5dgs-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        return None if _danger(folder) else folder
    except OSError:
        return None
