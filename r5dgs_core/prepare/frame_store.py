"""Frames of one size in a temporary file, so that memory does not grow with their number."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Sequence

import numpy as np


class FrameStore(Sequence[np.ndarray]):
    """Arrays of one shape and type, appended one by one; the file is closed and removed with the store."""

    def __init__(self):
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the store
        weakref.finalize(self, self._file.close)
        self._count = 0
        self._shape: tuple[int, ...] = ()
        self._dtype = np.dtype(np.uint8)

    def append(self, frame: np.ndarray) -> None:
        """Add a frame; all frames have the shape and type of the first one.

        Raises:
            ValueError: Its shape or type differs.
        """
        if not self._count:
            self._shape, self._dtype = frame.shape, frame.dtype
        if (frame.shape, frame.dtype) != (self._shape, self._dtype):
            raise ValueError(f"expected {self._shape} {self._dtype}, found {frame.shape} {frame.dtype}")
        self._file.seek(0, 2)
        self._file.write(np.ascontiguousarray(frame).data)
        self._count += 1

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> np.ndarray:
        """Read a frame."""
        return self._read(range(self._count)[index], 0, self._shape[0])

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Read some rows of all frames. [F, stop - start, ...]"""
        return np.stack([self._read(index, start, stop) for index in range(self._count)])

    def _read(self, index: int, start: int, stop: int) -> np.ndarray:
        found = np.empty((stop - start, *self._shape[1:]), self._dtype)
        row = found.nbytes // (stop - start)
        self._file.seek((index * self._shape[0] + start) * row)
        self._file.readinto(found.data)
        return found
