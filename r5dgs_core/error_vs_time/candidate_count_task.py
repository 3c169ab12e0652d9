"""Task "family": error of the selected motion model against the number of candidates and the time of the fit."""

from __future__ import annotations

import numpy as np

from ..data.dataset import GroundTruth
from ..evaluation import ground_truth_poses
from ..motion_fit import candidates
from ..scene.scene import Scene
from . import pose_task
from .report_rows import Row
from .task import Goal, Panel, Task, method_and_setting, percent

SIZES = (1, 2, 4, 8, 12, 16)  # smaller families, before the whole one
WHOLE = "whole family and breaks"


def measure(scene: Scene, ground_truth: GroundTruth | None) -> tuple[list[Row], list[str]]:
    """Return the rows of the task "family", for the poses at the last time with true poses.

    Each family holds the simplest candidates, that is, those with the fewest parameters. The last row is the selection
    that baking makes, which also tries breaks: starts, stops and impacts in the observed time. Times are processor
    times of the fits of all objects, measured once.

    Args:
        scene: The scene.
        ground_truth: True poses, or None if the data set has none.

    Returns:
        The rows, and the reasons for missing measurements.
    """
    if ground_truth is None:
        return [], ["family: no true poses are known (a data set has them in ground_truth.json)"]
    bodies = ground_truth_poses.bodies(scene, ground_truth)
    if not bodies or not (ground_truth.times > scene.t_max).any():
        return [], ["family: no object of the scene has true poses past t_max"]
    names = [candidate.name for candidate in candidates.FAMILY]
    families = {size: tuple(names[:size]) for size in SIZES if size < len(names)} | {len(names): tuple(names)}
    pose_task.fit_all(scene, bodies, tuple(names[:1]))  # the first fit loads and compiles
    later = bodies[0].times == bodies[0].times[-1]
    rows = []
    for label, chosen in [*((_label(n), family) for n, family in families.items()), (_label(len(names)), None)]:
        fitted = pose_task.fit_all(scene, bodies, chosen)
        models = [pose_task.model_of(body, fit) for body, fit in zip(bodies, fitted.fits, strict=True)]
        taus = bodies[0].times[later] - scene.t_max
        motion = [pose_task.model_motion(body, model, taus) for body, model in zip(bodies, models, strict=True)]
        shared = {
            "task": "family",
            "mode": "rigid/fitted",
            "method": label,
            "setting": WHOLE if chosen is None else f"up to: {chosen[-1]}",
            "clock": "cpu",
            "ms": fitted.ms,
            "ms_low": fitted.ms,
            "ms_high": fitted.ms,
            "ms_cpu": fitted.ms,
        }
        rows += pose_task.errors(scene, bodies, later, np.stack(motion), shared)
    return rows, []


def _label(size: int) -> str:
    return f"{size} candidate{'s' * (size > 1)}"


TASK = Task(
    "family",
    "Family: poses at the last time against the number of candidates and the time of the fits",
    lambda request: measure(request.scene, request.data.ground_truth),
    Panel(
        "position",
        "position error, % of the object's size",
        lambda row, scene: (
            f"Choosing the motion model of {row.count} objects (numbers: candidates): median error at the end"
        ),
        lambda row: row.setting if row.setting == WHOLE else row.method.split()[0],
        floor=1e-4,
        factor=100.0,
        subject="the fits of all objects",
        series=lambda row: (row.mode, ""),
        in_line=lambda row: True,
    ),
    Goal("position", 1e-3, percent, method_and_setting, worst_object=True),
    needs_data=True,
    over_objects=True,
    has_quartiles=False,
)
