"""Faults of files as data, as listed by `r5dgs check`, and guards that let readers continue after a fault.

A reader takes a `Guard` and enters it around each item (a frame, an image, an array). `STRICT`, the default, propagates
the first error. A `Collector` records errors and lets the reader continue without the item, so that `check` applies the
same rules as the reader. `UNREAD` replaces a value whose error was recorded.
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
MAX_FINDINGS = 10_000  # per file, so that a malicious file cannot fill the memory
Guard = Callable[[], AbstractContextManager[Any]]
_NOTHING = contextlib.nullcontext()


def _let_through() -> AbstractContextManager[None]:
    return _NOTHING  # one shared object, because readers enter the guard for every entry of a row


STRICT: Guard = _let_through


class _Unread:
    """Value whose error was recorded. Any use but ``is`` raises, which a `Collector` drops."""

    __hash__ = None  # type: ignore[assignment]

    def __eq__(self, other: object) -> NoReturn:
        raise TypeError("the value could not be read")

    def __bool__(self) -> NoReturn:
        raise TypeError("the value could not be read")

    def __array__(self, *_: object, **__: object) -> NoReturn:
        raise TypeError("the value could not be read")


UNREAD: Any = _Unread()


def attempt(guard: Guard, read: Callable[[], T]) -> T:
    """Return the result of a function, or `UNREAD` if the guard recorded its error."""
    with guard():
        return read()
    return UNREAD


@dataclass(frozen=True)
class Code:
    """Kind of fault.

    Attributes:
        severity: `ERROR` if the reader refuses the file; `WARNING` if it reads the file, but probably not as intended.
        meaning: Short description.
        remedy: Advice for findings without their own.
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
        place: Path of the file or folder.
        problem: Expected and found content.
        remedy: Advice to the user.
        picture: File of a picture that shows it, or "".
    """

    code: str
    severity: str
    place: str
    problem: str
    remedy: str
    picture: str = ""

    def __str__(self) -> str:
        stop = "" if self.problem.endswith((".", "?", "!")) else "."
        text = f"{self.code} {self.severity} {self.place}: {self.problem}{stop} Remedy: {self.remedy}"
        return f"{text}. Picture: {self.picture}" if self.picture else text


@contextlib.contextmanager
def coded(code: str, *, instead: bool = False) -> Iterator[None]:
    """Set the code of errors raised in the block if they have none; with ``instead``, replace existing codes too."""
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
        """Guard of an item: record an error of the reader instead of propagating it.

        After a recorded error, values that later items depend on may be missing, so other exceptions are dropped.
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

    def add(self, code: str, message: str, picture: str = "") -> None:
        """Record a fault; beyond `MAX_FINDINGS`, record once that there are more.

        Args:
            code: Code of the fault.
            message: "place: problem; remedy" or "place: problem. Remedy: remedy", the forms of error messages. Without
                a remedy, that of the code is used.
            picture: File of a picture that shows it, or "".
        """
        kind = self.codes[code]
        body, mark, remedy = message.partition("Remedy: ")
        if not mark:
            body, _, remedy = message.rpartition("; ") if "; " in message else (message, "", "")
        place, _, problem = body.strip().rstrip(".").partition(": ")
        if not problem:
            place, problem = place, kind.meaning
        if len(self._known) == MAX_FINDINGS:
            problem, remedy = f"more than {MAX_FINDINGS} faults; the others are not listed", ""
        finding = Finding(code, kind.severity, place, problem, remedy.strip() or kind.remedy, picture)
        if finding not in self._known and len(self._known) <= MAX_FINDINGS:
            self._known.add(finding)
            self.findings.append(finding)
