"""Task "training": PSNR of held-out views against the time of training, from the log of a run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..train import step_log
from ..train.run_folder import LOG_FILE, RUN_FILE
from . import image_task
from .report_rows import Row
from .task import Goal, Measured, Panel, Request, Task, decibels, method_and_setting


def measure(folder: Path | None, test: Sequence[Row] = ()) -> tuple[list[Row], list[str]]:
    """Return the rows of the task "training".

    Each probe of the run is a row of kind "psnr@val". The time counts from the start of training and includes the
    probes; it is processor time, or wall time if the log has no processor time. The final scene is a row of kind
    "psnr@test".

    Args:
        folder: The run folder, or None for a scene file.
        test: Rows of the task "images" for the split "test", in the mode of the final scene.

    Returns:
        The rows, and the reasons for missing measurements.
    """
    if folder is None:
        return [], ["training: a scene file holds no log of its training; give the run folder"]
    try:
        log = step_log.read(folder / LOG_FILE)
        config = json.loads((folder / RUN_FILE).read_text())["config"]["train"]
    except (OSError, ValueError, KeyError) as error:
        return [], [f"training: {folder / LOG_FILE}: cannot be read ({error}); train again"]
    steps = [event for event in log if event.get("event") == "step" and "seconds" in event]
    probes = [event for event in steps if "val_psnr" in event]
    if not probes:
        return [], [
            f"training: {folder / LOG_FILE} holds no PSNR of held-out views; train with train.probe_every > 0 on data "
            "that has views of the split val"
        ]
    absent = []
    if any("cpu_seconds" not in event for event in steps):
        absent.append(f"training: {folder / LOG_FILE} holds wall times only (it is of an older version), so the time "
                      "of training is wall time; train again for processor time")  # fmt: skip
    clock = "wall" if absent else "cpu"
    label = f"{config['representation']}, {config['iterations']} steps"
    note = f"mean of up to {config['probe_views']} views of val"
    rows = [_row(event, label, clock, "psnr@val", event["val_psnr"], note) for event in probes]
    final = [row for row in test if row.error_kind == "psnr" and row.setting == "test"]
    if final and steps[-1]["iteration"] == config["iterations"]:
        rows.append(_row(steps[-1], label, clock, "psnr@test", final[0].error, ""))
    return rows, absent


def _row(event: dict[str, Any], label: str, clock: str, kind: str, psnr: float, note: str) -> Row:
    wall = 1e3 * event["seconds"]
    ms = 1e3 * event["cpu_seconds"] if clock == "cpu" else wall
    return Row(
        task="training",
        mode="",
        method=label,
        setting=f"step {event['iteration']}",
        error_kind=kind,
        error=float(psnr),
        ms=ms,
        ms_low=ms,
        ms_high=ms,
        ms_wall=wall,
        **({"ms_cpu": ms} if clock == "cpu" else {}),
        clock=clock,
        note=note,
    )


def _measure(request: Request) -> Measured:
    played = [row for row in request.rows if row.task == image_task.TASK.name and row.mode == "rigid"]
    folder = request.place if request.place and request.place.is_dir() else None
    return measure(folder, [row for row in played if row.method != image_task.ORACLE])


TASK = Task(
    "training",
    "Training: held-out views against the time of training",
    _measure,
    Panel(
        "psnr@val",
        "error of pixels of held-out views, 8-bit levels (rms)",
        lambda row, scene: f"Training ({row.method}; numbers: steps)",
        lambda row: row.setting.removeprefix("step "),
        floor=1e-3,
        subject="training",
        series=lambda row: (row.mode, row.method),
        in_line=lambda row: True,
    ),
    Goal("psnr@val", 0.3, decibels, method_and_setting),
    in_seconds=True,
    has_quartiles=False,
)
