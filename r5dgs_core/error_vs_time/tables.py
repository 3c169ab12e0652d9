"""Tables of the report "error against run time", for the terminal and as Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from .. import terminal
from ..bench.tables import Sheet, to_rich
from . import report_rows
from .report_rows import Row

ABSENT = "-"
FRONT = "*"
CLOCKS = {"wall": "wall time", "cpu": "processor time over all threads"}
_TITLES = {
    "dynamics": "Dynamics: integrators against a fine reference",
    "poses": "Poses: predicted object poses at the last time against the truth",
    "images": "Images: pictures of each mode against true images",
    "raster": "Rasterizer: thresholds against the finest picture",
}
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
    """Return the tables of a report: one per task with rows, and the poses along the horizon.

    Args:
        report: Result of `report.measure`.
    """
    found = []
    for task, rows in report_rows.by_task(report_rows.from_dicts(report["rows"])).items():
        now = [row for row in rows if not row.error_kind.partition("@")[2].startswith("t=")]
        found.append(_sheet(task, now, report))
        if len(now) < len(rows):
            found.append(_horizon(rows))
    return found


def markdown(report: dict[str, Any]) -> str:
    """Return all tables, the missing measurements, and the machine, as Markdown."""
    count, tau = report["gaussians"], report["horizon"]["tau"]
    parts = [
        f"# Error against run time: {report['scene']}\n\n{count} Gaussians, {report['groups']} motion groups, "
        f"t_max {report['t_max']:.4g}; integrated to {tau:.4g} past it ({report['horizon']['why']}).\n"
    ]
    for sheet in sheets(report):
        rule = ["---"] * sheet.words + ["---:"] * (len(sheet.head) - sheet.words)
        lines = [sheet.head, tuple(rule), *(line for block in sheet.blocks for line in block)]
        cells = [[cell.replace("|", "\\|").replace("*", "\\*") for cell in line] for line in lines]
        table = "\n".join("| " + " | ".join(line) + " |" for line in cells)
        parts.append(f"## {sheet.title}\n\n{table}\n\n{sheet.caption.replace('*', chr(92) + '*')}\n")
    if report["absent"]:
        parts.append("## Not measured\n\n" + "\n".join(f"- {text}" for text in report["absent"]) + "\n")
    machine = report["machine"]
    parts.append(
        f"## How\n\n`ms` is {CLOCKS[report['clock']]}. Medians of {report['rounds']} rounds in which all methods took "
        f"turns, on {machine['processor']}, "
        f"{machine['cores']} usable cores, {machine['raster_threads']} threads of the rasterizer, "
        f"GPU: {machine['gpu'] or 'none'}. Docs: docs/user/report.md.\n"
    )
    return "\n".join(parts)


def _sheet(task: str, rows: Sequence[Row], report: dict[str, Any]) -> Sheet:
    kinds = report_rows.kinds_of(rows)
    split = any(math.isfinite(row.ms_motion) for row in rows)
    once = any(math.isfinite(row.ms_once) for row in rows)
    head = ["mode", "method", "setting", *(_head(kind) for kind in kinds), "ms", "quartiles", "wall ms", "CPU ms"]
    head += ["motion ms", "raster ms"] if split else []
    head += ["once, ms"] if once else []
    lines: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        lines.setdefault((row.mode, row.method, row.setting), []).append(row)
    cells = []
    notes: dict[str, None] = {}
    for key, some in lines.items():
        by_kind = {row.error_kind: row for row in some}
        first = some[0]
        line = [*key, *(_error(by_kind.get(kind)) for kind in kinds)]
        line += [
            _short(first.ms),
            f"{_short(first.ms_low)} - {_short(first.ms_high)}",
            _short(first.ms_wall),
            _short(first.ms_cpu),
        ]
        line += [_short(first.ms_motion), _short(first.ms_raster)] if split else []
        line += [_short(first.ms_once)] if once else []
        if math.isnan(first.ms):
            line[3 + len(kinds) + 1] = ABSENT
        cells.append(tuple(line))
        if first.note:
            notes[f"{first.method}{', ' + first.setting if first.method == 'playback' else ''}: {first.note}"] = None
    caption = f"{FRONT} on the Pareto front: no better method is as fast; less is better"
    better = [_head(kind) for kind in kinds if report_rows.KINDS[kind.partition("@")[0]].more_is_better]
    caption += f", but more of {', '.join(better)}" if better else ""
    if task in ("dynamics", "poses"):
        caption += "; medians over objects, worst in brackets"
    if notes:
        caption += ". " + ". ".join(notes)
    return Sheet(_TITLES[task], tuple(head), (tuple(cells),), caption, words=3)


def _horizon(rows: Sequence[Row]) -> Sheet:
    """Return position and rotation errors of the poses at every time past t_max."""
    later = sorted(
        {row.error_kind.partition("@t=")[2] for row in rows if "@t=" in row.error_kind}, key=float
    )  # rows of the last time have no suffix
    head = ["mode", "method", *(f"t = {t}" for t in later), "last"]
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
        cells.append((*key, *line))
    caption = "median over objects: position in % of the object's size / rotation in degrees"
    return Sheet("Poses along the horizon", tuple(head), (tuple(cells),), caption, words=2)


def _head(kind: str) -> str:
    name, _, where = kind.partition("@")
    return f"{_HEADS[name]} ({where})" if where else _HEADS[name]


def _error(row: Row | None) -> str:
    if row is None:
        return ABSENT
    form = _FORMS[row.error_kind.partition("@")[0]]
    worst = (
        f" ({form(row.error_worst)})" if row.task in ("dynamics", "poses") and math.isfinite(row.error_worst) else ""
    )
    return form(row.error) + worst + (f" {FRONT}" if row.pareto else "")


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
    """Print the tables and the missing measurements."""

    for sheet in sheets(report):
        table, console = to_rich(sheet), terminal.console()
        wide = console.measure(table, options=console.options.update(width=1000)).maximum
        terminal.console(width=max(min(wide, 240), console.width)).print(table)  # too wide is better than truncated
    for text in report["absent"]:
        print(f"not measured: {text}")
