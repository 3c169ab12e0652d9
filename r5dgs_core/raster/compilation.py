"""Compilation, caching and multithreaded execution of numba kernels: those of the `cpu` backend and of training.

A kernel is a function ``kernel(worker, workers, ...)`` that does its share of the work without the interpreter lock.
Plain Python threads run the shares. Compared with numba's parallel loops, this compiles in a fraction of the time,
allows calls from several threads, and gives results that do not depend on a threading layer.

Machine code is cached between processes. The first compilation of a process is announced by a warning, or as set by
`announcing`.
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
NOTICE_UNKEPT = "rasterizer: compiling its kernels, which cannot be cached; 10 to 30 s in every process"

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_INNER: dict[str, Any] = {"no_cpython_wrapper": True}

_SHARED = ("raster/**/*.py", "scene/spherical_harmonics.py")  # sources that any kernel may use
_OURS = re.compile("r5dgs-[0-9a-f]{12}")
_KEPT_S = 28 * 24 * 3600.0
_SYSTEM_USERS = (0, 65534)  # root, and the owner that root's files have inside a user's container

_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_threads = max(1, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


def kernel(function) -> Any:
    """Compile a function on its first call, without the interpreter lock, and cache the machine code on disk.

    The cache is keyed by the content of the file that defines ``function`` and of `shared_sources`. A kernel outside
    this package may therefore use only constants and helpers of these files.
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
    """Compile a function for use inside kernels only, as part of their machine code.

    Calling it from Python crashes the interpreter, as it has no wrapper that unpacks Python objects.
    """
    return numba.njit(**_OPTIONS, **_INNER)(function)


class _Watch(numba_events.Listener):
    """Listener for kernel compilations in this process, which numba's own lock serializes. Cache loads are not seen.

    Garbage collection is disabled during a compilation, because scanning the compiler's objects takes a twelfth of the
    time.
    """

    def __init__(self) -> None:
        self.kernels: weakref.WeakSet = weakref.WeakSet()
        self.compiled = 0
        self.announce: Callable[[str], object] = log.warning
        self._depth = 0  # nesting: a kernel and its helpers
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
            self.announce(NOTICE if cache_folder() else NOTICE_UNKEPT)

    def on_end(self, event) -> None:
        if self._depth == 1 and self._collects:
            gc.enable()
        self._depth = max(0, self._depth - 1)


_watch = _Watch()
numba_events.register("numba:compile", _watch)


def compiled() -> int:
    """Number of kernels that this process has compiled, because they were not cached."""
    return _watch.compiled


@contextlib.contextmanager
def announcing(announce: Callable[[str], object]) -> Iterator[None]:
    """Announce the process's first compilation, in any thread, by ``announce(text)`` instead of a logged warning."""
    before, _watch.announce = _watch.announce, announce
    try:
        yield
    finally:
        _watch.announce = before


def cache_folder() -> Path | None:
    """Folder of the machine code of this version, or None if no candidate is writable."""
    folder = _cache_folder(numba.config.CACHE_DIR)  # type: ignore[attr-defined]
    return None if folder is None else Path(folder)


def set_threads(count: int) -> None:
    """Set the number of threads for `run`; the default is NUMBA_NUM_THREADS, or the usable cores."""
    global _pool, _threads
    if count < 1:
        raise ValueError(f"threads: expected at least 1, got {count}")
    with _lock:
        _pool, _threads = None, count  # the old threads end once they are unreferenced


def threads() -> int:
    """Number of threads for `run`."""
    return _threads


def run(function, work: int, *arguments) -> None:
    """Call ``function(worker, workers, *arguments)`` for all workers in parallel and wait for them.

    Args:
        function: A `kernel` whose result does not depend on ``workers``.
        work: Number of threads that the work can keep busy; with fewer than two, the calling thread does it all.
        arguments: Passed on.
    """
    run_parts(function, min(_threads, work), *arguments)


def run_parts(function, parts: int, *arguments) -> None:
    """Call ``function(part, parts, *arguments)`` for every part, on the available threads, and wait for them.

    For kernels whose parts must match over several calls; use `run` for all others.
    """
    if parts < 2:
        function(0, 1, *arguments)
        return
    pool = _get_pool()
    others = [pool.submit(function, part, parts, *arguments) for part in range(1, parts)]
    try:
        function(0, parts, *arguments)
    finally:  # the arrays must outlive all shares, even if ours raised
        for other in others:
            other.result()


def _get_pool() -> ThreadPoolExecutor:
    global _pool
    with _lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(max(1, _threads - 1), "r5dgs-raster")
        return _pool


def _forget_pool() -> None:
    """Reset lock and pool in a forked child, which inherits no threads."""
    global _lock, _pool
    _lock, _pool = threading.Lock(), None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pool)


@functools.cache
def _cache_folder(chosen: str) -> str | None:
    """Folder for machine code, one per state of the shared sources; None if no candidate is writable.

    numba checks only the modification time and size of the kernel's own file, not of the files of its helpers and
    constants, hence the digest.
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
        if danger is not None:  # never load machine code that other users can replace
            log.warning("rasterizer: compiled code is not cached in %s, as %s; remedy: remove it", folder, danger)
            tried.append(f"{base} (others can write there)")
            continue
        with contextlib.suppress(OSError):
            os.utime(folder)  # marks the folder as in use, see `_remove_old`
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
    """Return the reason why other users can put code into a folder, or None if they cannot."""
    if not hasattr(os, "getuid"):  # Windows: folders inherit the permissions of the user's profile
        return None
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
        return "it is a link or belongs to another user"
    if status.st_mode & 0o022:
        return "others can write there"
    for parent in folder.resolve().parents:  # a user who can rename a parent folder can replace this one
        status = parent.stat()
        if status.st_uid not in (os.getuid(), *_SYSTEM_USERS):
            return f"{parent} belongs to another user"
        if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
            return f"others can write in {parent}"
    return None


def shared_sources() -> list[Path]:
    """Source files that any kernel may use besides its own: helpers and frozen constants."""
    core = Path(__file__).parents[1]
    return sorted(path for pattern in _SHARED for path in core.glob(pattern))


def _digest(sources: Iterable[Path]) -> str:
    """First 12 hexadecimal digits of the SHA-256 of the files' contents."""
    digest = hashlib.sha256()
    for source in sources:
        digest.update(source.read_bytes())
    return digest.hexdigest()[:12]


def _remove_old(base: Path) -> None:
    """Remove machine code of other versions that was not used for four weeks; ignore folders that cannot be removed."""
    for folder in base.glob("r5dgs-*"):
        with contextlib.suppress(OSError):
            status = folder.lstat()
            unused_s = time.time() - status.st_mtime
            if _OURS.fullmatch(folder.name) and stat.S_ISDIR(status.st_mode) and unused_s > _KEPT_S:
                shutil.rmtree(folder, ignore_errors=True)


def _bases(chosen: str) -> Iterator[Path]:
    """Yield candidate folders for machine code, best first: the user's choice, the user's cache, a temporary one."""
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
    except RuntimeError:  # no HOME, and no entry in the user database
        return None
    return Path(base) / "r5dgs" / "numba"


def _own_temporary() -> Path | None:
    """Temporary folder that only this user can write, or None."""
    try:
        if not hasattr(os, "getuid"):  # Windows: the temporary folder is private
            return Path(tempfile.gettempdir()) / "r5dgs"
        folder = Path(tempfile.gettempdir()) / f"r5dgs-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        return None if _danger(folder) else folder
    except OSError:
        return None
