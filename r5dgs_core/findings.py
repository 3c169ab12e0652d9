"""Faults of files as data: what `r5dgs check` lists, and how readers go on after one.

A reader takes a `Guard` and enters it around each item (a frame, an image, an array). `STRICT`, the default, lets the
first error through. A `Collector` keeps errors and lets the reader go on without the item, so that `check` and the
reader have the same rules.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

from . import errors

ERROR, WARNING = "error", "warning"
Guard = Callable[[], AbstractContextManager[Any]]
STRICT: Guard = contextlib.nullcontext


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
        """Keep a fault.

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
        finding = Finding(code, kind.severity, place, problem, remedy.strip() or kind.remedy)
        if finding not in self.findings:
            self.findings.append(finding)
