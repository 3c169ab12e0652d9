"""``r5dgs report --stability``: stiff, extreme and degenerate cases that run the shipped code, one row each.

The cases read no files and use fixed seeds, so every run gives the same rows. Only the seconds differ, and on another
processor the last digits.
"""

from __future__ import annotations

import json
import math
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from .. import atomic_files, errors
from . import (
    contacts,
    extremes,
    float32_playback,
    groups,
    keys,
    loading,
    orders,
    playback,
    predictions,
    rotations,
    steps,
)
from .cases import MAX_SECONDS, Case, logged

CASES: tuple[Case, ...] = (
    *orders.CASES,
    *steps.CASES,
    *extremes.CASES,
    *rotations.CASES,
    *groups.CASES,
    *float32_playback.CASES,
    *playback.CASES,
    *predictions.CASES,
    *keys.CASES,
    *contacts.CASES,
    *loading.CASES,
)
_CAPTION = (
    f"Less is better. A case over {MAX_SECONDS:g} s of processor time fails. "
    "--json FILE adds the quantity, the function, the result of TRACE's integrator and "
    "the origin of each tolerance."
)


@dataclass(frozen=True)
class CaseResult:
    """Result of a case.

    Attributes:
        topic: Topic, by which rows are grouped.
        name: Description of the case.
        method: Tested functions, relative to the package.
        quantity: Measured quantity; less is better.
        measured: Measured value; NaN if the case raised an error.
        tolerance: Maximum value that passes.
        source: Origin of the tolerance.
        trace_rk2: The same value for TRACE's integrator, or None if it does not apply.
        passed: True if the value is within the tolerance and the case took at most `MAX_SECONDS`.
        seconds: Processor time of our code.
        message: Error of a case that raised one, else "".
    """

    topic: str
    name: str
    method: str
    quantity: str
    measured: float
    tolerance: float
    source: str
    trace_rk2: float | None
    passed: bool
    seconds: float
    message: str = ""


def run(cases: Iterable[Case] | None = None, progress: Callable[[int], None] | None = None) -> list[CaseResult]:
    """Measure cases. A case that raises an error fails with its message; the others still run.

    Args:
        cases: Cases to run; None for all.
        progress: Called with the number of finished cases.
    """
    rows: list[CaseResult] = []
    for case in CASES if cases is None else cases:
        rows.append(_measured(case))
        if progress is not None:
            progress(len(rows))
    return rows


def _measured(case: Case) -> CaseResult:
    message, start = "", 0.0
    # Warnings of the core are expected in extreme cases; only the value decides.
    with logged(), warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            if case.prepare is not None:
                case.prepare()
            start = time.process_time()
            value = float(case.measure())
        except Exception as error:  # any failure becomes a row of the table
            value, message = math.nan, f"{type(error).__name__}: {error}"
        seconds = time.process_time() - start
        other = None
        if case.trace_rk2 is not None:
            try:
                other = float(case.trace_rk2())
            except Exception as error:
                other, message = math.nan, message or f"trace_rk2: {type(error).__name__}: {error}"
    if seconds > MAX_SECONDS:
        message = message or f"took {seconds:.1f} s of processor time, expected at most {MAX_SECONDS:g}"
    passed = bool(value <= case.tolerance) and seconds <= MAX_SECONDS  # NaN does not pass
    return CaseResult(
        case.topic,
        case.name,
        case.method,
        case.quantity,
        value,
        case.tolerance,
        case.source,
        other,
        passed,
        seconds,
        message,
    )


def make(rows: Sequence[CaseResult]) -> Table:
    """Return the rows as a rich table."""
    table = Table(title="stability", title_justify="left", caption=_CAPTION, caption_justify="left")
    table.add_column("case", overflow="fold")
    for name in ("measured", "at most", "CPU s"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    topic = None
    for row in rows:
        if row.topic != topic:
            topic = row.topic
            table.add_section()
            table.add_row(f"[bold]{topic}[/bold]")
        figures = (f"{row.measured:.3g}", f"{row.tolerance:.3g}", f"{row.seconds:.2f}")
        result = "pass" if row.passed else "[bold red]FAIL[/bold red]"
        name = f"{row.name}: {row.message}" if row.message else row.name
        table.add_row(_plain(name), *figures, result)
    return table


def _plain(text: str) -> str:
    """Escape brackets, which rich reads as markup."""
    return text.replace("[", r"\[")


def summary(rows: Sequence[CaseResult]) -> str:
    """Return the number of passed cases, the failed ones and the time, as text."""
    failed = [row for row in rows if not row.passed]
    seconds = sum(row.seconds for row in rows)
    text = f"{len(rows) - len(failed)} of {len(rows)} cases pass, in {seconds:.1f} s of CPU time"
    return text + "".join(f"\nfailed: {row.topic}: {row.name}" for row in failed)


def to_json(rows: Sequence[CaseResult]) -> dict[str, Any]:
    """Return the rows as JSON types; non-finite numbers become "nan", "inf" and "-inf"."""
    return {
        "passed": sum(row.passed for row in rows),
        "failed": sum(not row.passed for row in rows),
        "seconds": sum(row.seconds for row in rows),
        "rows": [{key: _number(value) for key, value in asdict(row).items()} for row in rows],
    }


def _number(value: Any) -> Any:
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def write(rows: Sequence[CaseResult], path: Path) -> Path:
    """Write the rows as JSON; returns ``path``.

    Raises:
        ConfigError: The file cannot be written.
    """
    try:
        atomic_files.write(path, json.dumps(to_json(rows), indent=2).encode())
    except OSError as error:
        raise errors.ConfigError(f"{path}: the stability table cannot be written: {error}") from error
    return path
