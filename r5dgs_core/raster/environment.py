"""Checks of environment variables that numba reads. Imported before numba, which fails on them with tracebacks."""

from __future__ import annotations

import os

from ..errors import ConfigError

MAX_THREADS = 1024


def check_threads(value: str | None) -> None:
    """Raise `ConfigError` if a value of NUMBA_NUM_THREADS is not a number of threads; None and "" mean unset."""
    if not value:
        return
    if not (value.isascii() and value.isdecimal() and len(value) < 9 and 1 <= int(value) <= MAX_THREADS):
        raise ConfigError(
            f"NUMBA_NUM_THREADS={value[:40]!r}: expected a whole number from 1 to {MAX_THREADS}; correct or unset it"
        )


check_threads(os.environ.get("NUMBA_NUM_THREADS"))
