"""Safe terminal output: text from files, such as object names, can neither move the cursor nor forge a line."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from rich.console import Console

_JOINERS = "\u200c\u200d"  # zero-width letter joiners, which several scripts need


def printable(text: str, keep: str = "") -> str:
    """Return a text with invisible characters escaped, such as ``\\n`` and ``\\x1b``.

    Args:
        text: Any text, including unpaired surrogates.
        keep: Further characters to keep.
    """
    if text.isprintable():
        return text
    kept = keep + _JOINERS
    return "".join(c if c.isprintable() or c in kept else c.encode("unicode_escape").decode() for c in text)


def print_lines(texts: Iterable[str]) -> None:
    """Print each text on one line, with invisible characters escaped."""
    for text in texts:
        print(printable(text))


class _SafeStream:
    """Text stream that escapes control characters, except line breaks and tabs."""

    def __init__(self, stream: TextIO):
        self.unsafe = stream

    def write(self, text: str) -> int:
        self.unsafe.write(printable(text, "\n\t"))
        return len(text)

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.unsafe, name)


class _OneLine(logging.Formatter):
    """Log formatter that keeps each message on one line."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  # the name is logging's
        return printable(super().formatMessage(record))


@contextlib.contextmanager
def safe_output() -> Iterator[None]:
    """Escape control characters in everything that the block prints and logs; only `console` may style its output."""
    last = logging.lastResort
    assert last is not None
    before = last.formatter
    last.setFormatter(_OneLine())
    out: Any = _SafeStream(sys.stdout)
    err: Any = _SafeStream(sys.stderr)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            yield
    finally:
        last.setFormatter(before)


def console(**options: Any) -> Console:
    """Return a rich console on standard output that escapes control characters in its content."""
    from rich.console import Console
    from rich.segment import Segment

    class SafeConsole(Console):
        def render(self, *args: Any, **kwargs: Any) -> Iterator[Segment]:
            for segment in super().render(*args, **kwargs):
                safe = segment.control is not None
                yield segment if safe else Segment(printable(segment.text, "\n"), segment.style)

    return SafeConsole(file=getattr(sys.stdout, "unsafe", sys.stdout), **options)
