"""Faults of a run folder: run.json, checkpoints, evaluation, its scene files and its data set."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .. import errors, strict_json
from ..findings import Collector, Finding, coded
from . import data, scene
from .codes import CODES

if TYPE_CHECKING:  # torch
    from ..train.run_folder import Run


def check(folder: Path, pictures: Path | None = None) -> list[Finding]:
    """Return all faults of a run folder and its data set; pictures of those of the capture go to a folder if given."""
    from ..train import run_folder

    collect = Collector(CODES, "R01")
    run: run_folder.Run | None = None
    with collect():
        run = run_folder.open_run(folder)
    steps = _check_checkpoints(folder, collect)
    if run is not None and steps is not None and steps < run.config.train.iterations:
        collect.add("R12", f"{folder}: stopped at step {steps} of {run.config.train.iterations}")
    evaluation = folder / run_folder.EVALUATION_FILE
    if evaluation.exists():
        with collect(), coded("R04"):
            content = strict_json.read(evaluation, errors.CheckpointError)
            if not isinstance(content, dict) or not isinstance(content.get("splits"), dict):
                raise errors.CheckpointError(f"{evaluation}: expected an object with an object 'splits'")
    for path in sorted(folder.glob("*.r5dgs")):
        collect.findings += scene.check(path)
    if run is not None:
        _check_data(run, collect, pictures)
    return collect.findings


def _check_checkpoints(folder: Path, collect: Collector) -> int | None:
    """Read all generations of the checkpoint; returns the step of the newest valid one."""
    from ..train import checkpoint

    if checkpoint.newest_file(folder) is None:
        collect.add("R02", f"{folder / checkpoint.CHECKPOINT_FILE}: expected a checkpoint, found none")
    steps = None
    damaged = []
    for name in checkpoint.GENERATIONS:
        if (folder / name).exists():
            try:
                state = checkpoint.read(folder / name)
                steps = state.iteration if steps is None else steps
            except errors.CheckpointError as error:
                damaged.append(error)
    remedy = "; train again with --overwrite" if steps is None else ""
    for error in damaged:
        collect.add("R03", f"{error}{remedy}")
    return steps


def _check_data(run: Run, collect: Collector, pictures: Path | None) -> None:
    from ..data import dataset

    root = None
    with collect(), coded("R10"):
        root = run.data()
    if root is None:
        return
    section = run.config.data
    collect.findings += data.check(root, section.masks, section.min_registered, pictures)
    try:
        found = dataset.read(root, section.masks, section.min_registered)
    except errors.R5dgsError:
        collect.add("R10", f"{root}: the data set of the run has faults, which are listed too")
        return
    if found.digest != run.digest:
        collect.add("R11", f"{root}: expected the data set that the run was trained on, but the data have changed")
