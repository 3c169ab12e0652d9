"""Report "error against run time": integrators, poses, pictures and rasterizer settings of one scene.

Compared methods are timed in interleaved rounds (`timing`), and every time is reported with its error.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import atomic_files, timing
from ..data.dataset import Dataset
from ..errors import ConfigError
from ..render import machine
from ..scene.scene import Scene
from . import image_task, integrator_task, pareto_plot, pose_task, rasterizer_task, report_rows, tables
from .report_rows import Row

JSON_FILE, CSV_FILE, MARKDOWN_FILE, PLOT_FILE = "report.json", "report.csv", "report.md", "report.png"
ROUNDS = 7
SHARE = 1 / 3  # horizon past t_max without test views, as a share of the observed time


def measure(
    scene: Scene,
    dataset: Dataset | None = None,
    *,
    tasks: Sequence[str] = report_rows.TASKS,
    splits: Sequence[str] = ("test",),
    rounds: int = ROUNDS,
    clock: str = "wall",
    backend: str = "auto",
    progress: Callable[[dict[str, Any]], None] = lambda event: None,
) -> dict[str, Any]:
    """Measure a scene.

    Args:
        scene: The scene.
        dataset: Its data set, with images and true poses to compare with; None skips these comparisons.
        tasks: Tasks from `report_rows.TASKS`.
        splits: Splits whose images are compared; the first one determines the Pareto front.
        rounds: Timing rounds, over which medians and quartiles are taken.
        clock: "wall", or "cpu" for processor time, which is less sensitive to other load.
        backend: Rasterizer.
        progress: Called with events.

    Returns:
        In JSON types ``scene gaussians groups t_max horizon rounds clock machine kinds absent rows``. ``horizon`` is
        the time past t_max at which integration errors are measured, ``absent`` lists missing measurements with the
        reason, and ``rows`` holds `report_rows.Row`.
    """
    tau, why = horizon(scene, dataset)
    rows: list[Row] = []
    absent = [f"{task}: not asked for" for task in report_rows.TASKS if task not in tasks]
    for task in (task for task in report_rows.TASKS if task in tasks):
        if task != "images":
            progress({"event": "report", "text": task})
        measured, missing = _measure_task(task, scene, dataset, tau, splits, rounds, clock, backend, progress)
        rows += measured
        absent += missing
    busy = _busy(rows)
    if busy > timing.BUSY and clock == "wall":
        absent.append(
            f"wall times of an idle machine: here they are {busy:.1f} times the processor times (median); "
            "measure again when nothing else runs, or with --clock cpu"
        )
    rows = report_rows.mark_front(rows)
    return {
        "scene": scene.name,
        "gaussians": len(scene.gaussians.means),
        "groups": len(scene.groups),
        "t_max": scene.t_max,
        "horizon": {"tau": tau, "why": why},
        "rounds": rounds,
        "clock": clock,
        "machine": {**machine.describe(), "versions": machine.versions()},
        "kinds": {k: {"label": v.label, "more_is_better": v.more_is_better} for k, v in report_rows.KINDS.items()},
        "absent": absent,
        "rows": [row.to_dict() for row in rows],
    }


def _measure_task(
    task: str,
    scene: Scene,
    dataset: Dataset | None,
    tau: float,
    splits: Sequence[str],
    rounds: int,
    clock: str,
    backend: str,
    progress: Callable[[dict[str, Any]], None],
) -> tuple[list[Row], list[str]]:
    """Return the rows of a task and the reasons for missing ones; ``tau`` is the horizon, other arguments `measure`."""

    def count(done: int, total: int) -> None:
        progress({"event": "images", "done": done, "total": total})

    if task == "dynamics":
        return integrator_task.measure(scene, tau, rounds, clock)
    if task == "raster":
        views = () if dataset is None else dataset.views(splits[0])
        return rasterizer_task.measure(scene, views, rounds, clock=clock, backend=backend)
    if task == "poses":
        if dataset is None:
            return [], ["poses: no data set was given, so no true poses are known"]
        return pose_task.measure(scene, dataset.ground_truth, rounds, clock)
    if dataset is None:
        return [], ["images: no data set was given, so there is nothing to compare with"]
    return image_task.measure(scene, dataset, splits, rounds, clock=clock, backend=backend, progress=count)


def _busy(rows: Sequence[Row]) -> float:
    """Return the median ratio of wall time to processor time, 1 without rows."""
    ratios = [row.ms_wall / row.ms_cpu for row in rows if row.ms_cpu > 0]
    return float(np.median(ratios)) if ratios else 1.0


def horizon(scene: Scene, dataset: Dataset | None) -> tuple[float, str]:
    """Return the time past t_max at which integrators are compared, > 0, and the reason for it."""
    last = [view.t for view in dataset.test] if dataset is not None else []
    if last and max(last) > scene.t_max:
        return float(max(last) - scene.t_max), "the last test time"
    span = float(scene.tracks.times[-1] - scene.tracks.times[0])
    return (SHARE * span, "a third of the observed time") if span > 0 else (1.0, "one unit of time")


def write(report: dict[str, Any], folder: Path) -> tuple[Path, ...]:
    """Write a report as JSON, CSV, Markdown and plot.

    Args:
        report: Result of `measure`.
        folder: Output folder, created if missing.

    Returns:
        Paths of the files.

    Raises:
        ConfigError: The files cannot be written.
    """
    rows = report_rows.from_dicts(report["rows"])
    content = {
        JSON_FILE: json.dumps(report, indent=2, allow_nan=False).encode(),
        CSV_FILE: report_rows.to_csv(rows).encode(),
        MARKDOWN_FILE: tables.markdown(report).encode(),
        PLOT_FILE: pareto_plot.png(report),
    }
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in content.items():
            atomic_files.write(folder / name, data)
            paths.append(folder / name)
    except OSError as error:
        raise ConfigError(f"--out {folder}: the report cannot be written: {error}") from error
    return tuple(paths)
