"""Tables of the report "error against run time", for the terminal and as Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from .. import terminal, timing
from ..bench.tables import Sheet, to_rich
from . import report_rows, tasks
from .report_rows import Row
from .task import Task

ABSENT = "-"
FRONT = "*"
_HEADS = {
    "position": "position, % of size",
    "rotation": "rotation, deg",
    "outside_band": "outside the 95 % band, %",
    "psnr": "PSNR, dB",
    "psnr_objects": "PSNR objects, dB",
    "ssim": "SSIM",
    "flip": "FLIP",
    "lpips": "LPIPS",
    "miou": "mIoU",
    "difference": "difference, levels",
}
_FORMS: dict[str, Callable[[float], str]] = {
    "position": lambda x: _short(100 * x),
    "rotation": lambda x: _short(x),
    "outside_band": lambda x: f"{100 * x:.1f}",
    "psnr": "{:.2f}".format,
    "psnr_objects": "{:.2f}".format,
    "ssim": "{:.4f}".format,
    "flip": "{:.4f}".format,
    "lpips": "{:.4f}".format,
    "miou": "{:.3f}".format,
    "difference": lambda x: _short(x),
}


def sheets(report: dict[str, Any]) -> list[Sheet]:
    """Return the tables of a report: in each scene, one per task with rows, and the poses along the horizon.

    Args:
        report: Result of `report.collect`.
    """
    found = []
    every = report_rows.from_dicts(report["rows"])
    for scene in report["scenes"]:
        own = [row for row in every if row.scene == scene["name"]]
        suffix = f" ({scene['name']}{_runs(scene)})"
        for name, rows in report_rows.by_task(own).items():
            now = [row for row in rows if not row.error_kind.partition("@")[2].startswith("t=")]
            found.append(_sheet(tasks.BY_NAME[name], now, suffix))
            if len(now) < len(rows):
                found.append(_horizon(rows, suffix))
    return found


def _runs(scene: dict[str, Any]) -> str:
    count = len(scene["runs"])
    return f", {count} runs" if count > 1 else ""


def markdown(report: dict[str, Any]) -> str:
    """Return all tables, the missing measurements, the recommendations and the machine, as Markdown."""
    parts = [f"# Error against run time: {', '.join(scene['name'] for scene in report['scenes'])}\n"]
    for scene in report["scenes"]:
        tau = scene["horizon"]["tau"]
        parts.append(
            f"{scene['name']}: {scene['gaussians']} Gaussians, {scene['groups']} motion groups, t_max "
            f"{scene['t_max']:.4g}; integrated to {tau:.4g} past it ({scene['horizon']['why']}). Runs: "
            f"{', '.join(run['place'] for run in scene['runs'])}.\n"
        )
    for sheet in sheets(report):
        rule = ["---"] * sheet.words + ["---:"] * (len(sheet.head) - sheet.words)
        lines = [sheet.head, tuple(rule), *(line for block in sheet.blocks for line in block)]
        cells = [[cell.replace("|", "\\|").replace("*", "\\*") for cell in line] for line in lines]
        table = "\n".join("| " + " | ".join(line) + " |" for line in cells)
        parts.append(f"## {sheet.title}\n\n{table}\n\n{sheet.caption.replace('*', chr(92) + '*')}\n")
    if missing := _absent(report):
        parts.append("## Not measured\n\n" + "\n".join(f"- {text}" for text in missing) + "\n")
    machine = report["machine"]
    parts.append(
        f"## Method\n\nMedians of {report['rounds']} rounds in which all methods took turns; fronts by "
        f"{timing.CLOCKS[report['clock']]}. On {machine['processor']}, "
        f"{machine['cores']} usable cores, {machine['raster_threads']} threads of the rasterizer, "
        f"GPU: {machine['gpu'] or 'none'}. Docs: docs/user/report.md.\n"
    )
    if texts := _recommendations(report):
        parts.append("## Recommendations\n\n" + "\n".join(f"- {text}" for text in texts) + "\n")
    return "\n".join(parts)


def _absent(report: dict[str, Any]) -> list[str]:
    """Return the missing measurements, with the scene if there are several."""
    several = len(report["scenes"]) > 1
    return [f"{s['name']}: {text}" if several else text for s in report["scenes"] for text in s["absent"]]


def _recommendations(report: dict[str, Any]) -> list[str]:
    several = len(report["scenes"]) > 1
    return [f"{r['scene']}: {r['text']}" if several else r["text"] for r in report["recommendations"]]


def _sheet(task: Task, rows: Sequence[Row], suffix: str) -> Sheet:
    kinds = report_rows.kinds_of(rows)
    lines: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        lines.setdefault((row.mode, row.method, row.setting), []).append(row)
    columns = [column for column in _columns(task, rows) if any(math.isfinite(column.value(row)) for row in rows)]
    cells = []
    notes: dict[str, None] = {}
    for key, some in lines.items():
        by_kind = {row.error_kind: row for row in some}
        line = [*key, *(_error(by_kind.get(kind)) for kind in kinds)]
        line += [column.text(some[0]) for column in columns]
        cells.append(tuple(line))
        if some[0].note:
            first = some[0]
            notes[f"{first.method}{', ' + first.setting if first.method == 'playback' else ''}: {first.note}"] = None
    caption = f"{FRONT} on the Pareto front: no method that is better beyond the noise is as fast; lower is better"
    better = [_head(kind) for kind in kinds if report_rows.KINDS[kind.partition("@")[0]].more_is_better]
    caption += f", except for {', '.join(better)}" if better else ""
    caption += "; medians over objects, worst in brackets" if task.over_objects else ""
    caption += "; medians over runs, range in square brackets" if any(row.runs > 1 for row in rows) else ""
    if notes:
        caption += ". " + ". ".join(notes)
    head = ("mode", "method", "setting", *(_head(kind) for kind in kinds), *(column.label for column in columns))
    return Sheet(task.title + suffix, head, (tuple(cells),), caption, words=3)


@dataclass(frozen=True)
class _Column:
    """Column of times: its heading, and the value and text of a row."""

    label: str
    value: Callable[[Row], float]
    text: Callable[[Row], str]


def _columns(task: Task, rows: Sequence[Row]) -> list[_Column]:
    """Return the columns of times, labelled with their clock and unit."""
    unit, factor = task.time_unit
    clock = timing.SHORT_CLOCKS[rows[0].clock]

    def column(label: str, name: str) -> _Column:
        def value(row: Row) -> float:
            return getattr(row, name)

        return _Column(label, value, lambda row: _short(factor * value(row)))

    def span(label: str, low: str, high: str) -> _Column:
        def text(row: Row) -> str:
            ends = factor * getattr(row, low), factor * getattr(row, high)
            return f"{_short(ends[0])} - {_short(ends[1])}" if math.isfinite(ends[0]) else ABSENT

        return _Column(label, lambda row: getattr(row, high), text)

    quartiles = [span(f"{clock} quartiles", "ms_low", "ms_high")] if task.has_quartiles else []
    return [
        column(f"wall {unit}", "ms_wall"),
        column(f"processor {unit}", "ms_cpu"),
        *quartiles,
        span(f"{clock} {unit} over runs", "ms_min", "ms_max"),
        column(f"motion, {clock} {unit}", "ms_motion"),
        column(f"raster, {clock} {unit}", "ms_raster"),
        column("fit once, processor ms", "ms_once_cpu"),
    ]


def _horizon(rows: Sequence[Row], suffix: str) -> Sheet:
    """Return position and rotation errors of the poses at every time past t_max."""
    later = sorted(
        {row.error_kind.partition("@t=")[2] for row in rows if "@t=" in row.error_kind}, key=float
    )  # rows of the last time have no suffix
    head = ["mode", "method", *(f"t = {t}" for t in later), "last", "worst"]
    lines: dict[tuple[str, str], dict[str, Row]] = {}
    for row in rows:
        if row.error_kind.startswith(("position", "rotation")):
            lines.setdefault((row.mode, row.method), {})[row.error_kind] = row
    cells = []
    for key, by_kind in lines.items():
        line = []
        for t in [*(f"@t={t}" for t in later), ""]:
            position, rotation = by_kind[f"position{t}"].error, by_kind[f"rotation{t}"].error
            line.append(f"{_short(100 * position)} / {_short(rotation)}")
        last = by_kind["position"]
        line.append(f"{_short(100 * last.error_worst)} {last.worst_name}")
        cells.append((*key, *line))
    caption = (
        "median over objects: position in % of the object's size / rotation in degrees; then the worst position at the "
        "last time, by object"
    )
    return Sheet(f"Poses along the horizon{suffix}", tuple(head), (tuple(cells),), caption, words=2)


def _head(kind: str) -> str:
    name, _, where = kind.partition("@")
    return f"{_HEADS[name]} ({where})" if where else _HEADS[name]


def _error(row: Row | None) -> str:
    if row is None:
        return ABSENT
    form = _FORMS[row.error_kind.partition("@")[0]]
    text = form(row.error)
    if math.isfinite(row.error_min):
        text += f" [{form(row.error_min)}..{form(row.error_max)}]"
    if tasks.BY_NAME[row.task].over_objects and math.isfinite(row.error_worst):
        name = f" {row.worst_name}" if row.worst_name else ""
        text += f" ({form(row.error_worst)}{name})"
    return text + (f" {FRONT}" if row.pareto else "")


def _short(value: float) -> str:
    """Format a number with three significant digits."""
    if not math.isfinite(value):
        return ABSENT
    if value == 0:
        return "0"
    if 0.001 <= abs(value) < 10000:
        digits = max(0, 2 - math.floor(math.log10(abs(value))))
        return f"{value:.{digits}f}"
    return f"{value:.1e}"


def show(report: dict[str, Any]) -> None:
    """Print the tables, the missing measurements and the recommendations."""

    for sheet in sheets(report):
        table, console = to_rich(sheet), terminal.console()
        wide = console.measure(table, options=console.options.update(width=1000)).maximum
        terminal.console(width=max(min(wide, 240), console.width)).print(table)  # too wide is better than truncated
    for text in _absent(report):
        print(f"not measured: {text}")
    for text in _recommendations(report):
        print(f"recommended: {text}")
