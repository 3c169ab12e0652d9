"""Rows of the report "error against run time".

A row is one error of one method, with its time. The Pareto front (`mark_front`) is taken over the rows of a task with
the same kind of error.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

TASKS = ("dynamics", "poses", "images", "raster")


@dataclass(frozen=True)
class Kind:
    """Kind of error.

    Attributes:
        label: Label for users.
        more_is_better: True if larger values are better, as for PSNR.
    """

    label: str
    more_is_better: bool = False


KINDS = {
    "position": Kind("position error, share of the object's size"),
    "rotation": Kind("rotation error, degrees"),
    "outside_band": Kind("share of true errors outside the 95 % band"),
    "psnr": Kind("PSNR, dB", more_is_better=True),
    "psnr_objects": Kind("PSNR on object pixels, dB", more_is_better=True),
    "ssim": Kind("SSIM", more_is_better=True),
    "flip": Kind("FLIP"),
    "lpips": Kind("LPIPS"),
    "miou": Kind("mIoU", more_is_better=True),
    "difference": Kind("difference to the finest picture, 8-bit levels (rms)"),
}


@dataclass(frozen=True)
class Row:
    """One error of one method, and its time.

    Attributes:
        task: Task, from `TASKS`.
        mode: Playback mode ("rigid/fitted"), or the kind of motion that is integrated.
        method: Integrator, motion model or rasterizer.
        setting: Settings of the method, such as steps or thresholds.
        error_kind: Key of `KINDS`, with "@t=..." appended for times before the last one, or "@split" for other splits.
        error: The error; the median if there are several objects.
        ms: Time of one frame by the report's clock, milliseconds, median over rounds; NaN if not timed.
        error_low: Lower quartile over objects; the error itself for one object.
        error_high: Upper quartile over objects.
        error_worst: Worst error over objects.
        ms_low: Lower quartile of ``ms`` over rounds.
        ms_high: Upper quartile of ``ms`` over rounds.
        ms_wall: Wall time, median over rounds.
        ms_cpu: Processor time over all threads, median over rounds.
        ms_motion: Part of ``ms`` spent on motion, if measured separately.
        ms_raster: Part of ``ms`` spent on rasterization.
        ms_once: Processor time of work done once per scene, such as a fit.
        count: Number of objects, Gaussians or images behind the error.
        note: Further information for the reader.
        pareto: True if the row is on the Pareto front of its task and kind of error.
    """

    task: str
    mode: str
    method: str
    setting: str
    error_kind: str
    error: float
    ms: float = math.nan
    error_low: float = math.nan
    error_high: float = math.nan
    error_worst: float = math.nan
    ms_low: float = math.nan
    ms_high: float = math.nan
    ms_wall: float = math.nan
    ms_cpu: float = math.nan
    ms_motion: float = math.nan
    ms_raster: float = math.nan
    ms_once: float = math.nan
    count: int = 1
    note: str = ""
    pareto: bool = False

    @property
    def kind(self) -> Kind:
        """Kind of the error."""
        return KINDS[self.error_kind.partition("@")[0]]

    def to_dict(self) -> dict[str, Any]:
        """Return the row as JSON types, in the order of the report's columns; missing numbers become None."""
        values = {name: getattr(self, name) for name in COLUMNS}
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


_FIRST = ("task", "mode", "method", "setting", "error_kind", "error", "ms", "pareto")
COLUMNS = (*_FIRST, *(f.name for f in fields(Row) if f.name not in _FIRST))


def spread(values: np.ndarray, *, more_is_better: bool = False) -> dict[str, float]:
    """Return median, quartiles and worst of several errors, by the names of `Row`; NaN if there are none."""
    values = np.asarray(values, np.float64)
    if not len(values):
        return dict.fromkeys(("error", "error_low", "error_high", "error_worst"), math.nan)
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    worst = values.min() if more_is_better else values.max()
    numbers = {"error": middle, "error_low": low, "error_high": high, "error_worst": worst}
    return {name: float(value) for name, value in numbers.items()}


def mark_front(rows: Sequence[Row]) -> list[Row]:
    """Return the rows with the Pareto front of each task and kind of error marked.

    A row is dominated by a row that is better and not slower. Times whose quartiles overlap count as equal, so of
    methods that are equally fast within noise only the best is on the front. Rows without time or error are not.

    Args:
        rows: Rows of any tasks and kinds.

    Returns:
        The rows in their order.
    """
    marked = list(rows)
    key = [(row.task, row.error_kind) for row in rows]
    for group in dict.fromkeys(key):
        members = [i for i, k in enumerate(key) if k == group]
        front: list[Row] = []
        for i in sorted(members, key=lambda i: (_badness(rows[i]), rows[i].ms)):
            row = rows[i]
            timed = math.isfinite(row.ms) and math.isfinite(row.error)
            on_front = timed and all(_faster(row, better) for better in front)
            front += [row] if on_front else []
            marked[i] = dataclasses.replace(row, pareto=on_front)
    return marked


def _badness(row: Row) -> float:
    return -row.error if row.kind.more_is_better else row.error


def _faster(row: Row, other: Row) -> bool:
    """Return True if a row is faster than another by more than the spread of both."""
    high = row.ms_high if math.isfinite(row.ms_high) else row.ms
    low = other.ms_low if math.isfinite(other.ms_low) else other.ms
    return high < low


def to_csv(rows: Sequence[Row]) -> str:
    """Return the rows as CSV with a header line; missing numbers are empty cells."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        writer.writerow(["" if value is None else value for value in row.to_dict().values()])
    return text.getvalue()


def by_task(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the non-empty lists of rows by task, in the order of `TASKS`."""
    found = {task: [row for row in rows if row.task == task] for task in TASKS}
    return {task: some for task, some in found.items() if some}


def kinds_of(rows: Sequence[Row]) -> list[str]:
    """Return the kinds of error of the rows, in order of appearance."""
    return list(dict.fromkeys(itertools.chain(row.error_kind for row in rows)))


def from_dicts(rows: Sequence[dict[str, Any]]) -> list[Row]:
    """Convert dicts of `Row.to_dict` back to rows; None becomes NaN."""
    found: list[dict[str, Any]] = [{k: math.nan if v is None else v for k, v in row.items()} for row in rows]
    return [Row(**values) for values in found]
