"""Rows of several runs of one scene, combined into one row each with its spread over the runs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from . import pareto_front
from .report_rows import Row

Key = tuple[str, str, str, str, str]
_MEDIANS = (
    *("error", "error_low", "error_high", "ms", "ms_low", "ms_high", "ms_wall", "ms_cpu"),
    *("ms_motion", "ms_raster", "ms_once_cpu"),
)


def lines(runs: Sequence[Sequence[Row]]) -> dict[Key, dict[int, Row]]:
    """Return the rows of several runs by task, mode, method, setting and kind of error, then by number of the run."""
    found: dict[Key, dict[int, Row]] = {}
    for number, rows in enumerate(runs):
        for row in rows:
            found.setdefault((row.task, row.mode, row.method, row.setting, row.error_kind), {})[number] = row
    return found


def combine(runs: Sequence[Sequence[Row]], scene: str = "") -> list[Row]:
    """Return one row per method with medians over runs, and with the Pareto front marked.

    Args:
        runs: Rows of each run of a scene.
        scene: Name of the scene.
    """
    by_key = lines(runs)
    groups: dict[tuple[str, str], dict[Key, dict[int, Row]]] = {}
    for key, line in by_key.items():
        groups.setdefault((key[0], key[-1]), {})[key] = line
    best = set().union(*(pareto_front.front(group) for group in groups.values()))
    return [
        dataclasses.replace(combine_rows(list(line.values())), scene=scene, pareto=key in best)
        for key, line in by_key.items()
    ]


def combine_rows(rows: Sequence[Row]) -> Row:
    """Return the medians over the runs of one row, with the worst object of all runs."""
    if len(rows) == 1:
        return rows[0]
    values: dict[str, Any] = {
        name: _finite_statistic([getattr(row, name) for row in rows], np.median) for name in _MEDIANS
    }
    worst = (min if rows[0].kind.more_is_better else max)(
        rows, key=lambda row: row.error_worst if math.isfinite(row.error_worst) else 0.0
    )
    for name in ("error", "ms"):
        values[f"{name}_min"] = _finite_statistic([getattr(row, name) for row in rows], np.min)
        values[f"{name}_max"] = _finite_statistic([getattr(row, name) for row in rows], np.max)
    note = " / ".join(dict.fromkeys(row.note for row in rows if row.note))
    clock = rows[0].clock if len({row.clock for row in rows}) == 1 else "wall"
    return dataclasses.replace(
        rows[0],
        **values,
        error_worst=worst.error_worst,
        worst_name=worst.worst_name,
        note=note,
        clock=clock,
        runs=len(rows),
    )


def _finite_statistic(values: Sequence[float], statistic: Any) -> float:
    """Return a statistic of the finite values, NaN if there are none."""
    known = [value for value in values if math.isfinite(value)]
    return float(statistic(known)) if known else math.nan
