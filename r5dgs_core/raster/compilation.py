"""Compilation of numba kernels: those of the `cpu` backend and of training.

A kernel is a function ``kernel(worker, workers, ...)`` that does its share of the work without the interpreter lock.
Plain Python threads run the shares (`thread_pool`). Compared with numba's parallel loops, this compiles in a fraction
of the time, allows calls from several threads, and gives results that do not depend on a threading layer.

Machine code is cached between processes (`kernel_cache`). The first compilation of a process is announced by a warning,
or as set by `announcing`.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import threading
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
from numba.core import event as numba_events

from . import kernel_cache

log = logging.getLogger(__name__)

NOTICE = "rasterizer: compiling its kernels for this machine, once; 10 to 30 s"
NOTICE_UNKEPT = "rasterizer: compiling its kernels, which cannot be cached; 10 to 30 s in every process"

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_INNER: dict[str, Any] = {"no_cpython_wrapper": True}

_lock = threading.Lock()


def kernel(function) -> Any:
    """Compile a function on its first call, without the interpreter lock, and cache the machine code on disk.

    The cache is keyed by the content of the file that defines ``function`` and of `kernel_cache.shared_sources`. A
    kernel outside this package may therefore use only constants and helpers of these files.
    """
    with _lock:
        before = numba.config.CACHE_DIR  # type: ignore[attr-defined]
        folder = kernel_cache.folder_of(before)
        source = Path(function.__code__.co_filename)
        own = None if folder is None else os.path.join(folder, kernel_cache.digest_of([source]))
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
            self.announce(NOTICE if kernel_cache.cache_folder() else NOTICE_UNKEPT)

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


def _forget_lock() -> None:
    """Reset the lock in a forked child, in which a thread of the parent may hold it forever."""
    global _lock
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_lock)
