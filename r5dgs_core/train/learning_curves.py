"""Plot of a run's learning curves: loss, PSNR of held-out views and number of Gaussians, over steps and seconds."""

from __future__ import annotations

import io
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .. import atomic_files
from . import step_log
from .run_folder import CURVES_FILE, LOG_FILE

log = logging.getLogger(__name__)

EVERY_S = 30.0  # minimum interval between two plots during a run, s
SHARE = 0.02  # maximum share of the run's time for plots
PANELS = (("loss", "loss", "log"), ("val_psnr", "held-out views, dB", "linear"), ("gaussians", "Gaussians", "linear"))


class LearningCurves:
    """Learning curves in a run folder, redrawn from time to time. A failure to draw is logged as a warning.

    Args:
        folder: The run folder, with its log.
    """

    def __init__(self, folder: Path):
        self.path = Path(folder) / CURVES_FILE
        self._last, self._cost, self._failed = time.monotonic(), 0.0, False

    def update(self, *, finished: bool = False) -> None:
        """Redraw the curves: always if ``finished``, else only if the cost is small relative to the time since."""
        waited = time.monotonic() - self._last
        if self._failed or (not finished and waited < max(EVERY_S, self._cost / SHARE)):
            return
        began = time.monotonic()
        try:
            rows = step_log.read(self.path.with_name(LOG_FILE))
            if len(rows) > 1:
                atomic_files.write(self.path, draw(rows))
        except Exception as error:  # a missing matplotlib or a full disk must not end the run
            self._failed = True
            log.warning("%s: the learning curves cannot be drawn: %s: %s", self.path, type(error).__name__, error)
        self._last = time.monotonic()
        self._cost = self._last - began


def draw(rows: Sequence[dict[str, Any]]) -> bytes:
    """Plot loss, PSNR of held-out views (if there are any) and number of Gaussians; returns a PNG.

    Args:
        rows: Lines of the log (docs/reference/run_folder.md).
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = [panel for panel in PANELS if any(row.get(panel[0]) is not None for row in rows)]
    figure = Figure(figsize=(9.0, 2.4 * len(shown)), layout="constrained")
    axes = figure.subplots(len(shown), 2, sharey="row", sharex="col", squeeze=False)
    for (name, label, scale), pair in zip(shown, axes, strict=True):
        known = [row for row in rows if row.get(name) is not None]
        for axis, over in zip(pair, ("iteration", "seconds"), strict=True):
            marker = "." if len(known) < 40 else ""
            axis.plot([row[over] for row in known], [row[name] for row in known], marker=marker, linewidth=1.2)
            axis.grid(alpha=0.3)
            axis.set_yscale(scale)
        pair[0].set_ylabel(label)
    axes[-1][0].set_xlabel("steps")
    axes[-1][1].set_xlabel("seconds")
    stream = io.BytesIO()
    FigureCanvasAgg(figure).print_png(stream)
    return stream.getvalue()
