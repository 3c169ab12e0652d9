"""Answers of the worker: one line of JSON, followed by the raw bytes of the arrays that it announces, in order."""

from __future__ import annotations

import json
from typing import IO, Any

import numpy as np


def write(stream: IO[bytes], header: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """Write an answer: its header, extended by ``arrays``, and the arrays."""
    entries = [{"name": n, "dtype": a.dtype.str, "shape": list(a.shape)} for n, a in arrays.items()]
    stream.write(json.dumps({**header, "arrays": entries}).encode() + b"\n")
    for array in arrays.values():
        stream.write(np.ascontiguousarray(array).tobytes())
    stream.flush()


def read_arrays(stream: IO[bytes], header: dict[str, Any]) -> dict[str, np.ndarray] | None:
    """Read the arrays that a header announces; None if the stream ends before them.

    Raises:
        ValueError, KeyError, TypeError: The header is invalid.
    """
    arrays = {}
    for entry in header.get("arrays", ()):
        dtype, shape = np.dtype(entry["dtype"]), tuple(entry["shape"])
        size = dtype.itemsize * int(np.prod(shape, dtype=np.int64))
        blob = stream.read(size)
        if len(blob) != size:
            return None
        arrays[entry["name"]] = np.frombuffer(blob, dtype).reshape(shape)
    return arrays
