"""Threads that run the shares of kernels: plain Python threads, as kernels hold no interpreter lock."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor

import numba

_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_threads = max(1, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


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
        function: A `compilation.kernel` whose result does not depend on ``workers``.
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
