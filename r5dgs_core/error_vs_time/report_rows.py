"""Rows of the report "error against run time".

A row is one error of one method, with its time. `pareto_front` compares the rows of a task with the same kind of error.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from . import task_names


@dataclass(frozen=True)
class Kind:
    """Kind of error.

    Attributes:
        label: Label for users.
        more_is_better: True if larger values are better, as for PSNR.
        min_difference: Minimum difference that counts, in the unit of the error.
        min_relative_difference: Minimum difference that counts, as a share of the larger error.
    """

    label: str
    more_is_better: bool = False
    min_difference: float = 0.0
    min_relative_difference: float = 0.0


# Differences below the last printed digit, or due to rounding, do not count.
KINDS = {
    "position": Kind("position error, share of the object's size", min_difference=1e-9, min_relative_difference=0.01),
    "rotation": Kind("rotation error, degrees", min_difference=1e-7, min_relative_difference=0.01),
    "outside_band": Kind("share of true errors outside the 95 % band", min_difference=1e-3),
    "psnr": Kind("PSNR, dB", more_is_better=True, min_difference=0.01),
    "psnr_objects": Kind("PSNR on object pixels, dB", more_is_better=True, min_difference=0.01),
    "ssim": Kind("SSIM", more_is_better=True, min_difference=1e-4),
    "flip": Kind("FLIP", min_difference=1e-4),
    "lpips": Kind("LPIPS", min_difference=1e-4),
    "miou": Kind("mIoU", more_is_better=True, min_difference=1e-3),
    "difference": Kind(
        "difference to the finest picture, 8-bit levels (rms)", min_difference=1e-3, min_relative_difference=0.01
    ),
}


@dataclass(frozen=True)
class Row:
    """One error of one method, and its time: of one run, or the median of several runs of a scene.

    Attributes:
        task: Task, from `task_names.TASKS`.
        mode: Playback mode ("rigid/fitted"), or the kind of motion that is integrated.
        method: Integrator, motion model or rasterizer.
        setting: Settings of the method, such as steps or thresholds.
        error_kind: Key of `KINDS`, with "@t=..." appended for times before the last one, or "@split" for other splits.
        error: The error; the median if there are several objects.
        ms: Time by ``clock``, milliseconds, median over rounds; NaN if not timed. Time of one frame, except in the
            tasks "training" (time from the start of training) and "family" (time of the fits of all objects).
        error_low: Lower quartile over objects; the error itself for one object.
        error_high: Upper quartile over objects.
        error_worst: Worst error over objects.
        worst_name: Name of the object with the worst error.
        ms_low: Lower quartile of ``ms`` over rounds.
        ms_high: Upper quartile of ``ms`` over rounds.
        ms_wall: Wall time, median over rounds.
        ms_cpu: Processor time over all threads, median over rounds.
        ms_motion: Part of ``ms`` spent on motion, if measured separately.
        ms_raster: Part of ``ms`` spent on rasterization.
        ms_once_cpu: Processor time of work done once per scene, such as a fit.
        count: Number of objects, Gaussians or images behind the error.
        note: Further information for the reader.
        pareto: True if the row is on the Pareto front of its task and kind of error.
        clock: Clock of ``ms``, its quartiles and its parts: "wall", or "cpu" for processor time.
        scene: Name of the scene, or of its group of runs.
        runs: Number of runs.
        error_min: Smallest error over runs.
        error_max: Largest error over runs.
        ms_min: Smallest ``ms`` over runs.
        ms_max: Largest ``ms`` over runs.
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
    ms_once_cpu: float = math.nan
    count: int = 1
    note: str = ""
    pareto: bool = False
    worst_name: str = ""
    clock: str = "wall"
    scene: str = ""
    runs: int = 1
    error_min: float = math.nan
    error_max: float = math.nan
    ms_min: float = math.nan
    ms_max: float = math.nan

    @property
    def kind(self) -> Kind:
        """Kind of the error."""
        return KINDS[self.error_kind.partition("@")[0]]

    def to_dict(self) -> dict[str, Any]:
        """Return the row as JSON types, in the order of the report's columns; missing numbers become None."""
        values = {name: getattr(self, name) for name in COLUMNS}
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


_FIRST = ("scene", "task", "mode", "method", "setting", "error_kind", "error", "ms", "clock", "pareto")
COLUMNS = (*_FIRST, *(f.name for f in fields(Row) if f.name not in _FIRST))


def spread(values: np.ndarray, *, more_is_better: bool = False, names: Sequence[str] = ()) -> dict[str, Any]:
    """Return median, quartiles and worst of several errors, by the names of `Row`; NaN if there are none.

    Args:
        values: The errors. [B]
        more_is_better: True if the smallest value is the worst.
        names: Names of the objects, for ``worst_name``. [B], or empty
    """
    values = np.asarray(values, np.float64)
    if not len(values):
        return dict.fromkeys(("error", "error_low", "error_high", "error_worst"), math.nan)
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    worst = int(values.argmin() if more_is_better else values.argmax())
    numbers = {"error": middle, "error_low": low, "error_high": high, "error_worst": values[worst]}
    found: dict[str, Any] = {name: float(value) for name, value in numbers.items()}
    return found | ({"worst_name": names[worst]} if names else {})


def to_csv(rows: Sequence[Row]) -> str:
    """Return the rows as CSV with a header line; missing numbers are empty cells."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        writer.writerow(["" if value is None else value for value in row.to_dict().values()])
    return text.getvalue()


def by_task(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the non-empty lists of rows by task, in the order of `task_names.TASKS`."""
    found = {task: [row for row in rows if row.task == task] for task in task_names.TASKS}
    return {task: some for task, some in found.items() if some}


def kinds_of(rows: Sequence[Row]) -> list[str]:
    """Return the kinds of error of the rows, in order of appearance."""
    return list(dict.fromkeys(row.error_kind for row in rows))


def from_dicts(rows: Sequence[dict[str, Any]]) -> list[Row]:
    """Convert dicts of `Row.to_dict` back to rows; None becomes NaN."""
    found: list[dict[str, Any]] = [{k: math.nan if v is None else v for k, v in row.items()} for row in rows]
    return [Row(**values) for values in found]
