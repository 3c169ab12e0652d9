"""How the kernels of the `cpu` backend are compiled, cached and run on several threads.

A kernel is a function ``kernel(worker, workers, ...)`` that does its share of the work and releases the interpreter
lock. Plain Python threads run the shares: compiling takes a fraction of what numba's own parallel loops take, calls
from several threads at once are safe, and results cannot depend on a threading layer.
"""

from __future__ import annotations

import hashlib
import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numba

_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_threads = max(1, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


def kernel(function) -> Any:
    """Compile at the first call, without the interpreter lock, and keep the machine code for the next process."""
    with _lock:
        before = numba.config.CACHE_DIR  # type: ignore[attr-defined]
        numba.config.CACHE_DIR = _cache_folder(before)  # type: ignore[attr-defined]
        try:
            return numba.njit(nogil=True, cache=True, error_model="numpy")(function)
        finally:
            numba.config.CACHE_DIR = before  # type: ignore[attr-defined]


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
    workers = min(_threads, work)
    if workers < 2:
        function(0, 1, *arguments)
        return
    pool = _get_pool()
    others = [pool.submit(function, worker, workers, *arguments) for worker in range(1, workers)]
    try:
        function(0, workers, *arguments)
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


def _cache_folder(chosen: str) -> str:
    """Folder for machine code: under the user's choice or the user's cache, apart for each state of the kernels.

    Numba looks only at the file of the compiled function, not at those of the functions it calls, hence the digest.
    """
    digest = hashlib.sha256()
    folder = Path(__file__).parent
    for source in sorted([*folder.glob("cpu_*.py"), folder / "lanes.py"]):
        digest.update(source.read_bytes())
    return str((Path(chosen) if chosen else _user_cache()) / f"r5dgs-{digest.hexdigest()[:12]}")


def _user_cache() -> Path:
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "r5dgs" / "numba"
