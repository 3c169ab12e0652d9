"""Plot of error against run time for a benchmark."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .. import atomic_files
from ..errors import ConfigError
from . import tables

_MARKERS = "osD^vP*X"


def write(records: Sequence[dict[str, Any]], path: Path) -> Path:
    """Plot PSNR against training time, past t_max and in the observed time, and against the time of a frame.

    Args:
        records: Measured cases by mode (docs/user/bench.md). Colors show method and mode, markers show the scene.
        path: The PNG file.

    Raises:
        ConfigError: The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    figure = Figure(figsize=(13.5, 4.6), constrained_layout=True)
    canvas = FigureCanvasAgg(figure)
    scenes = list(dict.fromkeys(record["scene"] for record in records))
    kinds = list(dict.fromkeys((tables.method(record), record["mode"]) for record in records))
    panes = (
        ("test", "training", "training, seconds", "past t_max (test)"),
        ("val", "training", "training, seconds", "observed time (val)"),
        ("test", "playback", "a frame, ms", "past t_max (test)"),
    )
    for axes, (split, work, label, title) in zip(figure.subplots(1, 3), panes, strict=True):
        right = 0.0
        for record in records:
            psnr = record["splits"][split]["psnr"]
            ms = tables.training_ms(record) if work == "training" else record["playback"]["ms_frame"]
            if psnr is None or ms is None:
                continue
            kind = kinds.index((tables.method(record), record["mode"]))
            marker = _MARKERS[scenes.index(record["scene"]) % len(_MARKERS)]
            x = ms / 1e3 if work == "training" else ms
            axes.plot(x, psnr, marker, color=_color(kind), alpha=0.8)
            right = max(right, x)
        low, high = axes.get_ylim()
        axes.set(
            xlabel=label, ylabel="PSNR, dB", title=title, xlim=(0, 1.08 * right or 1), ylim=(low - 0.5, high + 0.5)
        )
        axes.grid(alpha=0.3)
    handles = [
        Line2D([], [], linestyle="", marker="o", color=_color(i), label=f"{name}, {mode}")
        for i, (name, mode) in enumerate(kinds)
    ]
    handles += [
        Line2D([], [], linestyle="", marker=_MARKERS[i % len(_MARKERS)], color="0.4", label=scene)
        for i, scene in enumerate(scenes)
    ]
    if handles:
        figure.legend(handles=handles, loc="outside right center", fontsize=8)
    buffer = io.BytesIO()
    canvas.print_png(buffer)
    try:
        atomic_files.write(path, buffer.getvalue())
    except OSError as error:
        raise ConfigError(f"{path}: the plot cannot be written: {error}") from error
    return path


def _color(index: int) -> tuple[float, float, float, float]:
    """Return one of twenty distinguishable colors, saturated ones first."""
    import matplotlib

    place = index % 20
    return matplotlib.colormaps["tab20"](2 * place if place < 10 else 2 * (place - 10) + 1)
