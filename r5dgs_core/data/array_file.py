"""Arrays in ``.npy`` files, read so that a damaged header can neither allocate memory nor raise an unusual error."""

from __future__ import annotations

import tokenize
from pathlib import Path

import numpy as np

from .. import errors

_DAMAGED = (OSError, ValueError, EOFError, TypeError, OverflowError, MemoryError, SyntaxError, tokenize.TokenError)


def read(path: Path, columns: int, remedy: str = "copy it again") -> np.ndarray:
    """Read a table of numbers.

    Args:
        path: The file.
        columns: Number of its columns.
        remedy: Remedy for errors.

    Returns:
        [N, columns] float64

    Raises:
        DatasetError: The file is damaged, or has another shape or type.
    """
    try:
        table = np.load(path, mmap_mode="r", allow_pickle=False)  # mapped, so that the file limits the size
        if table.ndim != 2 or table.shape[1] != columns or table.dtype.kind not in "fiu":
            raise ValueError(f"expected rows of {columns} numbers, found {table.dtype} of shape {table.shape}")
        return np.array(table, np.float64)
    except _DAMAGED as error:
        raise errors.DatasetError(f"{path}: damaged: {error}; {remedy}") from error
