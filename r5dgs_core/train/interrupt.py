"""Handling of SIGINT and SIGTERM during training: long phases stop at once, loops stop after the current step."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from ..errors import Interrupted

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def at_once(message: str) -> Iterator[None]:
    """Stop the block immediately on a signal; for work that is repeated from its start on resume.

    Args:
        message: Message of the error, with the command that resumes.

    Raises:
        Interrupted: A signal was received.
    """

    def stop(number: int, frame: Any) -> None:
        raise KeyboardInterrupt  # not an Exception, so that no handler on the way catches it

    with _handled_by(stop):
        try:
            yield
        except KeyboardInterrupt:
            raise Interrupted(message) from None


@contextmanager
def collected() -> Iterator[list[int]]:
    """Collect the numbers of received signals, for a loop to poll. A second signal of a kind has its usual effect."""
    asked: list[int] = []

    def note(number: int, frame: Any) -> None:
        asked.append(number)
        signal.signal(number, previous[number])

    with _handled_by(note) as previous:
        yield asked


@contextmanager
def _handled_by(handler: Callable[[int, Any], None]) -> Iterator[dict[int, Any]]:
    """Install a handler for both signals, yield the previous handlers and restore them at the end."""
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
