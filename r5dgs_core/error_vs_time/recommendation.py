"""Recommendations computed from the rows of a report: the fastest method whose error is nearly the least."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from . import image_task, pareto_front, pose_task, run_spread
from .pareto_front import Line
from .report_rows import Row
from .run_spread import Key


@dataclass(frozen=True)
class Goal:
    """Criterion of the recommendation for a task.

    Attributes:
        kind: Kind of error.
        slack: Maximum loss against the best method that is accepted for speed, in the unit of the error.
        form: Formats an error.
        loss: Formats a difference of errors.
        seconds: True if times are in seconds.
        worst_object: True if the object with the largest error counts. A median hides one object that moves on wrongly.
    """

    kind: str
    slack: float
    form: Callable[[float], str]
    loss: Callable[[float], str]
    seconds: bool = False
    worst_object: bool = False


def _percent(value: float) -> str:
    return f"{100 * value:.2g} % of the size"


def _decibels(value: float) -> str:
    return f"{value:.2f} dB"


def _levels(value: float) -> str:
    return f"{value:.2g} levels"


GOALS = {
    "dynamics": Goal("position", 1e-4, _percent, _percent),
    "poses": Goal("position", 1e-3, _percent, _percent, worst_object=True),
    "family": Goal("position", 1e-3, _percent, _percent, worst_object=True),
    "images": Goal("psnr", 0.3, _decibels, _decibels),
    "raster": Goal("difference", 0.5, _levels, _levels),
    "training": Goal("psnr@val", 0.3, _decibels, _decibels, seconds=True),
}
CLOCKS = {"wall": "wall", "cpu": "processor"}


def of(rows: Sequence[Row], lines: Mapping[Key, Line]) -> list[dict[str, Any]]:
    """Return a recommendation for each task with timed rows of one scene.

    The fastest method whose mean loss against the best is at most `Goal.slack` is recommended. Poses and families are
    judged by the object with the largest error. Rows of one motion model for all objects are excluded, because choosing
    the best of them requires the truth.

    Args:
        rows: Rows of the scene, combined over its runs.
        lines: The same rows in each run (`run_spread.lines`).

    Returns:
        In JSON types ``scene task text mode method setting clock ms error_kind error loss`` of each; ``loss`` is the
        loss against the best method.
    """
    found = []
    for task, goal in GOALS.items():
        chosen = [r for r in rows if r.task == task and r.error_kind == goal.kind and _selectable(r)]
        judged = [_judged(r, lines[task, r.mode, r.method, r.setting, r.error_kind], goal) for r in chosen]
        own = {id(row): line for row, line in judged}
        usable = [row for row, _ in judged if math.isfinite(row.error)]
        if not usable:
            continue
        sign = -1 if usable[0].kind.more_is_better else 1
        best = min(usable, key=lambda r: sign * r.error)

        def loss(row: Row, own: dict[int, Line] = own, best: Row = best) -> float:
            return _mean(pareto_front.losses(own[id(row)], own[id(best)]))

        pick = min((r for r in usable if loss(r) <= goal.slack), key=lambda r: r.ms)
        faster = [r for r in usable if pareto_front.is_faster(own[id(r)], own[id(pick)])]
        text = _text(goal, pick, best, loss(pick), own)
        if faster:
            next_one = min(faster, key=lambda r: sign * r.error)
            more = _mean(pareto_front.losses(own[id(next_one)], own[id(pick)]))
            text += f"; next faster: {_name(next_one)}, {_time(goal, next_one)}, costs {goal.loss(more)}"
        text += _beyond_true_poses(rows, pick) if task == "images" else ""
        named = {name: getattr(pick, name) for name in ("scene", "task", "mode", "method", "setting", "clock", "ms")}
        found.append({**named, "error_kind": goal.kind, "error": pick.error, "loss": loss(pick), "text": text})
    return found


def _selectable(row: Row) -> bool:
    return math.isfinite(row.ms) and not (row.task == "poses" and row.setting == pose_task.ALONE)


def _judged(row: Row, line: Line, goal: Goal) -> tuple[Row, Line]:
    """Return a combined row and its line with the errors that the goal counts."""
    if not goal.worst_object:
        return row, line
    worst = {run: dataclasses.replace(r, error=r.error_worst) for run, r in line.items()}
    return dataclasses.replace(run_spread.median(list(worst.values())), scene=row.scene), worst


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.inf


def _text(goal: Goal, pick: Row, best: Row, loss: float, own: Mapping[int, Line]) -> str:
    """Return the recommended method with its time, error, spread and margin."""
    spread = f" ({goal.form(pick.error_min)} to {goal.form(pick.error_max)} in {pick.runs} runs)"
    text = f"{pick.task}: {_name(pick)}, {_time(goal, pick)}, {goal.form(pick.error)}"
    text += spread if pick.runs > 1 else ""
    text += f" for the worst object ({pick.worst_name})" if goal.worst_object else ""
    if pick is best:
        return f"{text}; the best measured"
    same = not pareto_front.is_better(own[id(best)], own[id(pick)])
    margin = "as good as" if same else f"{goal.loss(loss)} {'below' if pick.kind.more_is_better else 'worse than'}"
    return f"{text}; {margin} the best ({_name(best)}, {_time(goal, best)}){' within the noise' if same else ''}"


def _beyond_true_poses(rows: Sequence[Row], pick: Row) -> str:
    """Return the comparison with true poses, which appearance learned with a wrong track may surpass."""
    for row in rows:
        if row.method == image_task.ORACLE and row.error_kind == pick.error_kind:
            side = "above" if pick.error > row.error else "below"
            return f"; {abs(pick.error - row.error):.2f} dB {side} true poses ({row.error:.2f} dB)"
    return ""


def _name(row: Row) -> str:
    return {
        "images": row.mode,
        "raster": row.setting,
        "training": f"{row.method}, {row.setting}",
        "family": f"{row.method}, {row.setting}",
        "dynamics": f"{row.method}, {row.setting}",
    }.get(row.task, f"{row.mode}, {row.method}")


def _time(goal: Goal, row: Row) -> str:
    value = f"{row.ms / 1e3:.3g} s" if goal.seconds else f"{row.ms:.3g} ms"
    return f"{value} ({CLOCKS[row.clock]})"
