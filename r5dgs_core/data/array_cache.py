"""Bounded cache of arrays that can be read again, with reading ahead in background threads.

The content of the cache never affects results: an array that was dropped is read again.
"""

from __future__ import annotations

import contextlib
import mmap
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

AHEAD = 2  # arrays that are read at the same time, and views that are read ahead
LARGE = 2**20  # least size of arrays in memory of their own, bytes

Read = Callable[[], np.ndarray]


class ArrayCache:
    """Arrays by key; the least recently used ones are dropped.

    Args:
        limit: Maximum size of all arrays, bytes. The newest one is always kept.
    """

    def __init__(self, limit: float):
        self._limit = limit
        self._held: OrderedDict[Hashable, np.ndarray] = OrderedDict()
        self._pending: dict[Hashable, Future[np.ndarray]] = {}
        self._bytes = 0
        self._lock = threading.RLock()  # arrays may be derived from others in the background
        self._pool: ThreadPoolExecutor | None = None

    @property
    def nbytes(self) -> int:
        """Size of the held arrays, bytes."""
        return self._bytes

    def get(self, key: Hashable, read: Read) -> np.ndarray:
        """Return an array, and read it if it is not held. Errors of ``read`` are raised here."""
        with self._lock:
            found = self._held.get(key)
            if found is not None:
                self._held.move_to_end(key)
                return found
            pending = self._pending.pop(key, None)
        return self._hold(key, _in_own_pages(read()) if pending is None else pending.result())

    def peek(self, key: Hashable) -> np.ndarray | None:
        """Return an array if it is held."""
        return self._held.get(key)

    def expect(self, key: Hashable, read: Read) -> None:
        """Begin to read an array in the background, unless it is held or too many others are being read."""
        with self._lock:
            if key in self._held or key in self._pending:
                return
            if len(self._pending) >= 2 * AHEAD:
                self._collect()
            if len(self._pending) < 2 * AHEAD:
                if self._pool is None:
                    self._pool = ThreadPoolExecutor(AHEAD, "r5dgs-images")
                self._pending[key] = self._pool.submit(lambda: _in_own_pages(read()))

    @contextlib.contextmanager
    def lent(self, nbytes: float) -> Iterator[None]:
        """Lower the limit by a number of bytes, which the caller uses for other things."""
        self._limit -= nbytes
        try:
            with self._lock:
                self._shrink()
            yield
        finally:
            self._limit += nbytes

    def clear(self) -> None:
        """Drop all arrays."""
        with self._lock:
            for future in self._pending.values():
                future.cancel()
            self._pending.clear()
            self._held.clear()
            self._bytes = 0

    def _collect(self) -> None:
        """Hold the arrays that were read but not used; reading a damaged one fails again when it is used."""
        for key, future in list(self._pending.items()):
            if future.done():
                del self._pending[key]
                if future.exception() is None:
                    self._hold(key, future.result())

    def _hold(self, key: Hashable, array: np.ndarray) -> np.ndarray:
        with self._lock:
            if key not in self._held:
                self._held[key] = array
                self._bytes += array.nbytes
            self._shrink()
        return array

    def _shrink(self) -> None:
        """Drop arrays until the limit holds, except for the newest one."""
        while self._bytes > self._limit and len(self._held) > 1:
            self._bytes -= self._held.popitem(last=False)[1].nbytes


def _in_own_pages(array: np.ndarray) -> np.ndarray:
    """Return a large array in pages of its own, which the system gets back when the array is dropped.

    The allocator of Linux keeps freed blocks of this size if small ones lie between them. If the system gives no
    pages, the array itself is returned.
    """
    if array.nbytes < LARGE or not hasattr(mmap, "MAP_PRIVATE"):
        return array
    try:
        pages = mmap.mmap(-1, array.nbytes, flags=mmap.MAP_PRIVATE)
    except OSError:  # such as a limit on memory or on the number of mappings
        return array
    copy = np.frombuffer(pages, array.dtype).reshape(array.shape)
    copy[...] = array
    return copy


@dataclass(frozen=True)
class CachedArray:
    """Array that is read when it is used.

    Attributes:
        cache: The cache that holds it.
        key: Its key there.
        read: Reads it.
    """

    cache: ArrayCache
    key: Hashable
    read: Read

    def __call__(self) -> np.ndarray:
        """Return the array."""
        return self.cache.get(self.key, self.read)

    def expect(self) -> None:
        """Begin to read the array in the background."""
        self.cache.expect(self.key, self.read)

    def derived(self, name: Hashable, change: Callable[[np.ndarray], np.ndarray]) -> CachedArray:
        """Return a function of the array as an array of its own, with ``name`` as part of its key."""

        def read() -> np.ndarray:
            held = self.cache.peek(self.key)
            return change(self.read() if held is None else held)

        return CachedArray(self.cache, (name, self.key), read)
