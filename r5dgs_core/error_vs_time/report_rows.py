"""Rows of the report "error against run time": what was measured, how wrong it was, how long it took.

A row is one error of one method. The front (`mark_front`) is taken over the rows of a task that have the same kind of
error.
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
    """A kind of error.

    Attributes:
        label: What people read.
        more_is_better: Whether larger numbers are better, as of PSNR.
    """

    label: str
    more_is_better: bool = False


KINDS = {
    "position": Kind("position error, share of the object's size"),
    "rotation": Kind("rotation error, degrees"),
    "outside_band": Kind("share of true errors outside the 2-sigma band"),
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
        task: One of `TASKS`.
        mode: Playback mode ("rigid/fitted"), or the kind of motion that is integrated.
        method: What was done: integrator, motion model, rasterizer.
        setting: Steps, thresholds, what the method was given.
        error_kind: A key of `KINDS`, with "@t" appended for errors at a time before the last one.
        error: The error; the median where it is of several objects.
        ms: Time of one frame by the report's clock, milliseconds; median over rounds. NaN where nothing was timed.
        error_low: Lower quartile over objects, or of one object the error.
        error_high: Upper quartile.
        error_worst: The worst.
        ms_low: Lower quartile over rounds.
        ms_high: Upper quartile.
        ms_wall: Wall time, median over rounds.
        ms_cpu: Processor time over all threads, median over rounds.
        ms_motion: Share of ``ms`` for motion, where it has several.
        ms_raster: Share of ``ms`` for rasterization.
        ms_once: Processor time of what was computed before, once per scene, such as a fit.
        count: Objects, Gaussians or images that the error is over.
        note: What else a reader must know.
        pareto: Whether it is on the front of its task and kind of error.
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
        """What the error is."""
        return KINDS[self.error_kind.partition("@")[0]]

    def to_dict(self) -> dict[str, Any]:
        """The row as JSON types, in the order of the report's columns; None where a number was not measured."""
        values = {name: getattr(self, name) for name in COLUMNS}
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


_FIRST = ("task", "mode", "method", "setting", "error_kind", "error", "ms", "pareto")
COLUMNS = (*_FIRST, *(f.name for f in fields(Row) if f.name not in _FIRST))


def spread(values: np.ndarray, *, more_is_better: bool = False) -> dict[str, float]:
    """Median, quartiles and worst of several errors, by the names of `Row`; NaN where there are none."""
    values = np.asarray(values, np.float64)
    if not len(values):
        return dict.fromkeys(("error", "error_low", "error_high", "error_worst"), math.nan)
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    worst = values.min() if more_is_better else values.max()
    numbers = {"error": middle, "error_low": low, "error_high": high, "error_worst": worst}
    return {name: float(value) for name, value in numbers.items()}


def mark_front(rows: Sequence[Row]) -> list[Row]:
    """The rows with those on the front marked: what no other row of the task and kind of error beats.

    A row is beaten by one that is better and not slower, where times whose quartiles overlap count as equal: of methods
    that take the same time within the noise only the best one is on the front. Rows without a time or an error are not.

    Args:
        rows: Of any tasks and kinds.

    Returns:
        The rows, in their order.
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
    """Whether a row is faster than another beyond the spread of both."""
    high = row.ms_high if math.isfinite(row.ms_high) else row.ms
    low = other.ms_low if math.isfinite(other.ms_low) else other.ms
    return high < low


def to_csv(rows: Sequence[Row]) -> str:
    """The rows with a header line; empty cells where nothing was measured."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        writer.writerow(["" if value is None else value for value in row.to_dict().values()])
    return text.getvalue()


def by_task(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows of each task that has some, in the order of `TASKS`."""
    found = {task: [row for row in rows if row.task == task] for task in TASKS}
    return {task: some for task, some in found.items() if some}


def kinds_of(rows: Sequence[Row]) -> list[str]:
    """The kinds of error of some rows, in the order in which they appear."""
    return list(dict.fromkeys(itertools.chain(row.error_kind for row in rows)))


def from_dicts(rows: Sequence[dict[str, Any]]) -> list[Row]:
    """Inverse of `Row.to_dict`: numbers that were not measured become NaN."""
    found: list[dict[str, Any]] = [{k: math.nan if v is None else v for k, v in row.items()} for row in rows]
    return [Row(**values) for values in found]
