"""Report "error against run time": integrators, poses, pictures, rasterizer settings and training of scenes.

Compared methods are timed in interleaved rounds (`timing`), and every time is reported with its error. Several runs of
a scene are combined into medians with their spread.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import atomic_files, timing
from ..data.dataset import Dataset
from ..errors import ConfigError
from ..evaluation import lpips
from ..render import machine
from ..scene.scene import Scene
from . import pareto_plot, recommendation, report_rows, run_spread, scene_groups, tables, task_names, tasks
from .report_rows import Row
from .task import Measured, Request, Task

JSON_FILE, CSV_FILE, MARKDOWN_FILE, PLOT_FILE = "report.json", "report.csv", "report.md", "report.png"
ROUNDS = 7
SHARE = 1 / 3  # horizon past t_max without test views, as a share of the observed time


@dataclass(frozen=True)
class Options:
    """Scope and settings of a measurement.

    Attributes:
        tasks: Tasks from `task_names.TASKS`.
        splits: Splits whose images are compared; the first one determines the Pareto front.
        rounds: Timing rounds, over which medians and quartiles are taken.
        clock: "wall", or "cpu" for processor time, which is less sensitive to other load.
        backend: Rasterizer.
        perceptual: Network for LPIPS, or None.
    """

    tasks: Sequence[str] = task_names.TASKS
    splits: Sequence[str] = ("test",)
    rounds: int = ROUNDS
    clock: str = "wall"
    backend: str = "auto"
    perceptual: lpips.Lpips | None = None


@dataclass(frozen=True)
class RunMeasurement:
    """Measurement of one run or scene file.

    Attributes:
        place: Path of the run or scene file.
        identity: Data and configuration without seed and threads; runs with equal ones are combined.
        facts: In JSON types ``scene gaussians groups t_max image_size horizon``. ``horizon`` is the time past t_max at
            which integration errors are measured.
        absent: Missing measurements with the reason.
        rows: The rows.
    """

    place: str
    identity: dict[str, Any]
    facts: dict[str, Any]
    absent: list[str]
    rows: list[Row]


def measure(
    scene: Scene,
    dataset: Dataset | None = None,
    options: Options | None = None,
    *,
    place: Path | None = None,
    progress: Callable[[dict[str, Any]], None] = lambda event: None,
) -> RunMeasurement:
    """Measure a scene.

    Args:
        scene: The scene.
        dataset: Its data set, with images and true poses to compare with; None skips these comparisons.
        options: Scope and settings; if None, all tasks on the split "test".
        place: Path of its run folder or scene file, or None.
        progress: Called with events.
    """
    options = options or Options()
    tau, why = horizon(scene, dataset)
    rows: list[Row] = []

    def count(done: int, total: int) -> None:
        progress({"event": "images", "done": done, "total": total})

    scope = (tuple(options.splits), options.rounds, options.clock, options.backend)
    request = Request(scene, dataset, place, tau, *scope, count, perceptual=options.perceptual)
    absent = [f"{task}: not requested" for task in task_names.TASKS if task not in options.tasks]
    for task in (task for name, task in tasks.BY_NAME.items() if name in options.tasks):
        if not task.counts:
            progress({"event": "report", "text": task.name})
        measured, missing = _measure_task(task, dataclasses.replace(request, rows=tuple(rows)))
        rows += measured
        absent += missing
    busy = _busy(rows)
    if busy > timing.BUSY and options.clock == "wall":
        absent.append(
            f"wall times without other load: the measured ones are {busy:.1f} times the processor times (median); "
            "measure again without other load, or with --clock cpu"
        )
    views = () if dataset is None else dataset.views(options.splits[0]) or dataset.train
    facts = {
        "scene": scene.name,
        "gaussians": len(scene.gaussians.means),
        "groups": len(scene.groups),
        "t_max": scene.t_max,
        "image_size": [views[0].camera.width, views[0].camera.height] if views else None,
        "horizon": {"tau": tau, "why": why},
    }
    name = scene.name if place is None else str(place)
    return RunMeasurement(name, scene_groups.identity(scene.name, scene.provenance), facts, absent, rows)


def _measure_task(task: Task, request: Request) -> Measured:
    if task.needs_data and request.dataset is None:
        return [], [f"{task.name}: no data set was given, so there is nothing to compare with"]
    return task.measure(request)


def collect(measured: Sequence[RunMeasurement], options: Options) -> dict[str, Any]:
    """Return the report on measured runs, those of one scene and configuration combined.

    Returns:
        In JSON types ``rounds clock machine kinds scenes rows recommendations``. ``scenes`` has the facts of a scene
        (`RunMeasurement`), its ``name``, ``runs`` and ``absent`` measurements. ``rows`` holds `report_rows.Row`, with
        medians and ranges over the runs. The rows of each run are in ``runs`` if there are several.
    """
    scenes, rows, recommendations = [], [], []
    for name, members in scene_groups.by_name({m.place: m.identity for m in measured}).items():
        runs = [m for m in measured if m.place in members]
        several = len(runs) > 1
        combined = run_spread.combine([run.rows for run in runs], name)
        rows += combined
        recommendations += recommendation.recommend(combined, run_spread.lines([run.rows for run in runs]))
        absent = dict.fromkeys(text for run in runs for text in run.absent)
        listed = [
            {"place": run.place, **run.facts} | ({"rows": [row.to_dict() for row in run.rows]} if several else {})
            for run in runs
        ]
        scenes.append({"name": name, **runs[0].facts, "runs": listed, "absent": list(absent)})
    return {
        "rounds": options.rounds,
        "clock": options.clock,
        "machine": {**machine.describe(), "versions": machine.versions()},
        "kinds": {k: {"label": v.label, "more_is_better": v.more_is_better} for k, v in report_rows.KINDS.items()},
        "scenes": scenes,
        "rows": [row.to_dict() for row in rows],
        "recommendations": recommendations,
    }


def _busy(rows: Sequence[Row]) -> float:
    """Return the median ratio of wall time to processor time, 1 without rows."""
    ratios = [row.ms_wall / row.ms_cpu for row in rows if row.ms_cpu > 0 and math.isfinite(row.ms_wall)]
    return float(np.median(ratios)) if ratios else 1.0


def horizon(scene: Scene, dataset: Dataset | None) -> tuple[float, str]:
    """Return the time past t_max at which integrators are compared, > 0, and the reason for it."""
    last = [view.t for view in dataset.test] if dataset is not None else []
    if last and max(last) > scene.t_max:
        return float(max(last) - scene.t_max), "the last test time"
    span = float(scene.tracks.times[-1] - scene.tracks.times[0])
    return (SHARE * span, "a third of the observed time") if span > 0 else (1.0, "one unit of time")


def write(report: dict[str, Any], folder: Path) -> tuple[Path, ...]:
    """Write a report as JSON, CSV, Markdown and one plot per scene.

    Args:
        report: Result of `collect`.
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
        **{name: pareto_plot.png(report, scene["name"]) for name, scene in _plots(report).items()},
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


def _plots(report: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the scenes by the name of their plot: ``report.png``, numbered from the second scene on."""
    stem, _, suffix = PLOT_FILE.partition(".")
    scenes = report["scenes"]
    return {f"{stem}_{i + 1}.{suffix}" if i else PLOT_FILE: scene for i, scene in enumerate(scenes)}
