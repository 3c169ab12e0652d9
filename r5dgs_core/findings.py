"""Faults of files as data: what `r5dgs check` lists, and how readers go on after one.

A reader takes a `Guard` and enters it around each item (a frame, an image, an array). `STRICT`, the default, lets the
first error through. A `Collector` keeps errors and lets the reader go on without the item, so that `check` and the
reader have the same rules. `UNREAD` replaces a value whose error was kept.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, NoReturn, TypeVar

from . import errors

T = TypeVar("T")
ERROR, WARNING = "error", "warning"
MOST_FINDINGS = 10_000  # of one file, so that a hostile one cannot fill the memory
Guard = Callable[[], AbstractContextManager[Any]]
_NOTHING = contextlib.nullcontext()


def _let_through() -> AbstractContextManager[None]:
    return _NOTHING  # one for all, as readers enter it for each entry of a row


STRICT: Guard = _let_through


class _Unread:
    """Value whose error was kept. Each use of it raises, which a `Collector` drops; only ``is`` may be applied."""

    __hash__ = None  # type: ignore[assignment]

    def __eq__(self, other: object) -> NoReturn:
        raise TypeError("the value could not be read")

    def __bool__(self) -> NoReturn:
        raise TypeError("the value could not be read")

    def __array__(self, *_: object, **__: object) -> NoReturn:
        raise TypeError("the value could not be read")


UNREAD: Any = _Unread()


def attempt(guard: Guard, read: Callable[[], T]) -> T:
    """Return the result of a function, or `UNREAD` if the guard kept an error of it."""
    with guard():
        return read()
    return UNREAD


@dataclass(frozen=True)
class Code:
    """A kind of fault.

    Attributes:
        severity: `ERROR`: the reader refuses the file. `WARNING`: it is read, but probably not what was meant.
        meaning: One phrase.
        remedy: Advice for findings that bring none of their own.
    """

    severity: str
    meaning: str
    remedy: str


@dataclass(frozen=True)
class Finding:
    """One fault.

    Attributes:
        code: Key of the table of codes.
        severity: `ERROR` or `WARNING`.
        place: File or folder.
        problem: Expected and found content.
        remedy: Advice to the user.
    """

    code: str
    severity: str
    place: str
    problem: str
    remedy: str

    def __str__(self) -> str:
        stop = "" if self.problem.endswith((".", "?", "!")) else "."
        return f"{self.code} {self.severity} {self.place}: {self.problem}{stop} Remedy: {self.remedy}"


@contextlib.contextmanager
def coded(code: str, *, instead: bool = False) -> Iterator[None]:
    """Give errors of a block a code: those without one, or all of them with ``instead``."""
    try:
        yield
    except errors.R5dgsError as error:
        error.code = code if instead else error.code or code
        raise


class Collector:
    """Findings of one file or folder, in the order of the reader.

    Args:
        codes: All codes, by name.
        fallback: Code of errors without one.
    """

    def __init__(self, codes: dict[str, Code], fallback: str):
        self.codes, self.fallback = codes, fallback
        self.findings: list[Finding] = []
        self._known: set[Finding] = set()

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        """Guard of an item: keep the error of a reader instead of passing it on.

        Once an error was kept, what later items need may be missing; other exceptions are then dropped.
        """
        try:
            yield
        except errors.Interrupted:
            raise
        except errors.R5dgsError as error:
            self.add(error.code or self.fallback, str(error))
        except (AttributeError, IndexError, KeyError, TypeError, ValueError):
            if not any(found.severity == ERROR for found in self.findings):
                raise

    def add(self, code: str, message: str) -> None:
        """Keep a fault; of more than `MOST_FINDINGS`, only that there are more.

        Args:
            code: Its code.
            message: "place: problem; remedy" or "place: problem. Remedy: remedy", as errors have it; the remedy of the
                code if there is none.
        """
        kind = self.codes[code]
        body, mark, remedy = message.partition("Remedy: ")
        if not mark:
            body, _, remedy = message.rpartition("; ") if "; " in message else (message, "", "")
        place, _, problem = body.strip().rstrip(".").partition(": ")
        if not problem:
            place, problem = place, kind.meaning
        if len(self._known) == MOST_FINDINGS:
            problem, remedy = f"more than {MOST_FINDINGS} faults; the others are not listed", ""
        finding = Finding(code, kind.severity, place, problem, remedy.strip() or kind.remedy)
        if finding not in self._known and len(self._known) <= MOST_FINDINGS:
            self._known.add(finding)
            self.findings.append(finding)
