"""Recommendations computed from the rows of a report: the fastest method whose error is nearly the least."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from .. import timing
from . import pareto_front, run_spread, tasks
from .pareto_front import Line
from .report_rows import Row
from .run_spread import Key
from .task import Goal, Task


def recommend(rows: Sequence[Row], lines: Mapping[Key, Line]) -> list[dict[str, Any]]:
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
    for name, task in tasks.BY_NAME.items():
        goal = task.goal
        chosen = [r for r in rows if r.task == name and r.error_kind == goal.kind and _selectable(goal, r)]
        judged = [_judged(r, lines[name, r.mode, r.method, r.setting, r.error_kind], goal) for r in chosen]
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
        text = _text(task, pick, best, loss(pick), own)
        if faster:
            next_one = min(faster, key=lambda r: sign * r.error)
            more = _mean(pareto_front.losses(own[id(next_one)], own[id(pick)]))
            text += f"; next faster: {goal.name(next_one)}, {_time(task, next_one)}, costs {goal.form(more)}"
        text += goal.remark(rows, pick)
        named = {key: getattr(pick, key) for key in ("scene", "task", "mode", "method", "setting", "clock", "ms")}
        found.append({**named, "error_kind": goal.kind, "error": pick.error, "loss": loss(pick), "text": text})
    return found


def _selectable(goal: Goal, row: Row) -> bool:
    return math.isfinite(row.ms) and goal.selectable(row)


def _judged(row: Row, line: Line, goal: Goal) -> tuple[Row, Line]:
    """Return a combined row and its line with the errors that the goal counts."""
    if not goal.worst_object:
        return row, line
    worst = {run: dataclasses.replace(r, error=r.error_worst) for run, r in line.items()}
    return dataclasses.replace(run_spread.combine_rows(list(worst.values())), scene=row.scene), worst


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.inf


def _text(task: Task, pick: Row, best: Row, loss: float, own: Mapping[int, Line]) -> str:
    """Return the recommended method with its time, error, spread and margin."""
    goal = task.goal
    spread = f" ({goal.form(pick.error_min)} to {goal.form(pick.error_max)} in {pick.runs} runs)"
    text = f"{pick.task}: {goal.name(pick)}, {_time(task, pick)}, {goal.form(pick.error)}"
    text += spread if pick.runs > 1 else ""
    text += f" for the worst object ({pick.worst_name})" if goal.worst_object else ""
    if pick is best:
        return f"{text}; the best measured"
    same = not pareto_front.is_better(own[id(best)], own[id(pick)])
    margin = "as good as" if same else f"{goal.form(loss)} {'below' if pick.kind.more_is_better else 'worse than'}"
    return f"{text}; {margin} the best ({goal.name(best)}, {_time(task, best)}){' within the noise' if same else ''}"


def _time(task: Task, row: Row) -> str:
    unit, factor = task.time_unit
    return f"{factor * row.ms:.3g} {unit} ({timing.SHORT_CLOCKS[row.clock]})"
