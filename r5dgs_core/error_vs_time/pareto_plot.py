"""Plot of error against run time: one panel per task, with the Pareto front and labelled points."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import timing
from ..evaluation import label_placement
from . import report_rows, tasks
from .report_rows import Row
from .task import Panel, Task

# Colors distinguishable with any color vision (Okabe and Ito 2008).
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F7F7F", "#000000")
_FRONT = "#B00020"
_DPI = 110
MIN_SPAN = 2.0  # minimum ratio between the ends of a time axis


@dataclass(frozen=True)
class _Point:
    """Point of a panel: position, range over runs, row, label and color."""

    x: float
    y: float
    low: float
    high: float
    row: Row
    name: str
    color: str


def png(report: dict[str, Any], name: str) -> bytes:
    """Return the plot of a scene as a PNG.

    Args:
        report: Result of `report.collect`; tasks without timed rows have no panel.
        name: Name of the scene.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scene = next(scene for scene in report["scenes"] if scene["name"] == name)
    own = report_rows.by_task([row for row in report_rows.from_dicts(report["rows"]) if row.scene == name])
    groups = [(tasks.BY_NAME[key], rows) for key, rows in own.items()]
    panels = [(task, points, _reference(task.panel, rows)) for task, rows in groups if (points := _points(task, rows))]
    columns = min(2, max(1, len(panels)))
    lines = max(1, math.ceil(len(panels) / 2))
    figure = Figure(figsize=(9.2 * columns, 6.9 * lines), dpi=_DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    count = len(scene["runs"])
    runs = f"; medians of {count} runs, bars: their range" if count > 1 else ""
    figure.suptitle(
        f"{name}: error against run time. {scene['gaussians']} Gaussians, {scene['groups']} motion "
        f"groups, {report['machine']['raster_threads']} threads{runs}.\n"
        "Lower and further left is better; red: the Pareto front, where no method that is better beyond the noise is "
        "as fast."
    )
    if not panels:
        figure.text(0.5, 0.5, "nothing could be timed", ha="center")
    grid = figure.subplots(lines, columns, squeeze=False).ravel() if panels else []
    for axes, (task, points, reference) in zip(grid, panels, strict=False):
        _draw(axes, task, points, scene)
        if reference is not None:
            axes.axhline(reference, color="0.35", linestyle="--", linewidth=1, zorder=0)
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    canvas.draw()  # computes the layout, so that pixel positions are known
    figure.set_layout_engine("none")
    for axes, (task, points, reference) in zip(grid, panels, strict=False):
        _name(axes, canvas.get_renderer(), task.panel, points, reference)
    buffer = io.BytesIO()
    canvas.print_png(buffer)
    return buffer.getvalue()


def _reference(panel: Panel, rows: Sequence[Row]) -> float | None:
    """Return the error of the reference method as drawn, or None."""
    found = [row for row in rows if row.method == panel.reference and row.error_kind == panel.kind]
    return _drawn(panel, found[-1], found[-1].error) if found else None


def _points(task: Task, rows: Sequence[Row]) -> list[_Point]:
    panel = task.panel
    shown = [row for row in rows if row.error_kind == panel.kind and math.isfinite(row.ms) and math.isfinite(row.error)]
    series = list(dict.fromkeys(panel.series(row) for row in shown))
    _, factor = task.time_unit
    points = []
    for row in shown:
        drawn = [_drawn(panel, row, value) for value in (row.error, row.error_min, row.error_max)]
        y, low, high = (max(v, panel.floor) if math.isfinite(v) else math.nan for v in drawn)
        color = _COLORS[series.index(panel.series(row)) % len(_COLORS)]
        points.append(_Point(factor * row.ms, y, min(low, high), max(low, high), row, panel.name(row), color))
    return points


def _drawn(panel: Panel, row: Row, error: float) -> float:
    """Return an error in the unit of the axis; a PSNR in dB becomes an RMS error in 8-bit levels."""
    return 255 * 10 ** (-error / 20) if row.kind.more_is_better else panel.factor * error


def _draw(axes: Any, task: Task, points: Sequence[_Point], scene: dict[str, Any]) -> None:
    panel, first = task.panel, points[0].row
    time_label = f"{timing.CLOCKS[first.clock]} of {panel.subject}, {task.time_unit[0]}"
    axes.set(xscale="log", yscale="log", xlabel=time_label, ylabel=panel.label)
    axes.set_title(panel.title(first, scene), fontsize=11, loc="left")
    if panel.in_line is not None:
        for series in dict.fromkeys(panel.series(p.row) for p in points):
            some = [p for p in points if panel.series(p.row) == series and panel.in_line(p.row)]
            color = next(iter(some), points[0]).color
            axes.plot([p.x for p in some], [p.y for p in some], "-", color=color, alpha=0.5, linewidth=1)
    for p in points:
        scale = p.x / p.row.ms
        several = math.isfinite(p.row.ms_max)
        ends = (p.row.ms_min, p.row.ms_max) if several else (p.row.ms_low, p.row.ms_high)
        axes.plot([scale * end for end in ends], [p.y, p.y], "-", color=p.color, alpha=0.3, linewidth=2)
        if math.isfinite(p.low):
            axes.plot([p.x, p.x], [p.low, p.high], "-", color=p.color, alpha=0.3, linewidth=2)
        marker = {"markeredgecolor": _FRONT, "markeredgewidth": 1.6} if p.row.pareto else {"markeredgewidth": 0}
        axes.plot(p.x, p.y, "o", color=p.color, markersize=6.5, **marker)
    front = sorted((p for p in points if p.row.pareto), key=lambda p: p.x)
    if front:
        axes.step([p.x for p in front], [p.y for p in front], where="post", color=_FRONT, linewidth=1.2, zorder=1)
    axes.margins(x=0.16, y=0.12)
    low, high = axes.get_xlim()
    if high < MIN_SPAN * low:  # a narrow axis would make noise look like a difference
        middle = math.sqrt(low * high)
        axes.set_xlim(middle / math.sqrt(MIN_SPAN), middle * math.sqrt(MIN_SPAN))
    axes.grid(alpha=0.25, which="major")
    _ticks(axes)
    if first.kind.more_is_better:
        _decibel_axis(axes)
    if any(p.y == panel.floor for p in points):
        axes.text(0.99, 0.01, f"lowest line: {panel.floor:g} or less", transform=axes.transAxes, ha="right", fontsize=8)


def _decibel_axis(axes: Any) -> None:
    from matplotlib.ticker import MaxNLocator, NullFormatter, ScalarFormatter

    right = axes.secondary_yaxis(
        "right", functions=(lambda y: -20 * np.log10(np.maximum(y, 1e-9) / 255), lambda dB: 255 * 10 ** (-dB / 20))
    )
    right.set_ylabel("PSNR, dB")
    right.yaxis.set_major_locator(MaxNLocator(8))
    right.yaxis.set_major_formatter(ScalarFormatter())
    right.yaxis.set_minor_formatter(NullFormatter())


def _ticks(axes: Any) -> None:
    """Use plain numbers on axes with a small range, so that they have tick labels."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        decades = math.log10(high / low)
        if decades < 5:
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        if decades < 2:
            axis.set_major_locator(LogLocator(subs=(1, 2, 5) if decades > 0.9 else (1, 1.5, 2, 3, 4, 5, 6, 8)))
        axis.set_minor_formatter(NullFormatter())


def _name(axes: Any, renderer: Any, panel: Panel, points: Sequence[_Point], reference: float | None) -> None:
    """Label the lines first, then points on the front, then other points while there is room."""
    frame = axes.get_window_extent(renderer)
    places = axes.transData.transform([(p.x, p.y) for p in points])
    markers = np.concatenate([places - 4, places + 4], axis=1)
    texts: list[tuple[np.ndarray, str, str, bool, float]] = []  # position, text, color, on the front, size
    if reference is not None:
        height = axes.transData.transform((points[0].x, reference))[1]
        texts.append((np.array([frame.x1 - 60, height]), panel.reference_name, "0.35", False, 8.5))
    if panel.line_name is not None:
        for series in dict.fromkeys(panel.series(p.row) for p in points):
            last = max(i for i, p in enumerate(points) if panel.series(p.row) == series)
            texts.append((places[last], panel.line_name(series), points[last].color, False, 9.5))
    for i in sorted(range(len(points)), key=lambda i: not points[i].row.pareto):
        p = points[i]
        texts.append((places[i], p.name, _FRONT if p.row.pareto else p.color, p.row.pareto, panel.label_size))
    sizes = []
    for _, text, _, bold, size in texts:
        probe = axes.text(0, 0, text, fontsize=size, fontweight="bold" if bold else "normal")
        box = probe.get_window_extent(renderer)
        sizes.append((box.width, box.height))
        probe.remove()
    bounds = np.array([frame.x0 + 2, frame.y0 + 2, frame.x1 - 2, frame.y1 - 2])
    boxes = label_placement.place(np.array([t[0] for t in texts]), np.array(sizes), bounds, markers)
    unnamed = 0
    for (place, text, color, bold, size), box in zip(texts, boxes, strict=True):
        if box is None:
            unnamed += 1
            continue
        middle = 0.5 * (box[:2] + box[2:])
        nearest = np.clip(place, box[:2], box[2:])
        if np.linalg.norm(nearest - place) > 12:
            ends = axes.transData.inverted().transform([place, nearest])
            axes.plot(ends[:, 0], ends[:, 1], "-", color=color, alpha=0.4, linewidth=0.7, zorder=1)
        at = axes.transData.inverted().transform(middle)
        style = {"fontsize": size, "fontweight": "bold" if bold else "normal", "ha": "center", "va": "center"}
        veil = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 0.3}
        axes.text(*at, text, color=color, bbox=veil, **style)
    if unnamed:
        axes.text(
            0.01,
            0.01,
            f"{unnamed} points without room for a label: see the table",
            transform=axes.transAxes,
            fontsize=8,
        )
