"""Ctrl-C and SIGTERM while training: long phases end at once, steps end after the one that runs."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from ..errors import Interrupted

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def at_once(message: str) -> Iterator[None]:
    """End the block where it is when a signal comes; for work that is begun again from its start.

    Args:
        message: How to go on.

    Raises:
        Interrupted: A signal came.
    """

    def stop(number: int, frame: Any) -> None:
        raise KeyboardInterrupt  # not an Exception, so that no code on the way takes it for a fault of its own

    with _handled_by(stop):
        try:
            yield
        except KeyboardInterrupt:
            raise Interrupted(message) from None


@contextmanager
def collected() -> Iterator[list[int]]:
    """The numbers of the signals that came, for a loop to look at; a second signal of one kind has its usual effect."""
    asked: list[int] = []

    def note(number: int, frame: Any) -> None:
        asked.append(number)
        signal.signal(number, previous[number])

    with _handled_by(note) as previous:
        yield asked


@contextmanager
def _handled_by(handler: Callable[[int, Any], None]) -> Iterator[dict[int, Any]]:
    """Install a handler for both signals; yields the previous ones and puts them back."""
    previous: dict[int, Any] = {}
    try:
        for number in SIGNALS:
            previous[number] = signal.signal(number, handler)
    except ValueError:  # not the main thread: the caller handles signals
        previous.clear()
    try:
        yield previous
    finally:
        for number, handler_before in previous.items():
            signal.signal(number, handler_before)
