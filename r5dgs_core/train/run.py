"""A whole training run: steps, log, checkpoints, identity encodings; interrupted and resumed without a trace."""

from __future__ import annotations

import dataclasses
import json
import signal
import time
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from ..data import dataset as datasets
from ..errors import CheckpointError, Interrupted
from ..scene import files
from . import checkpoint, identity, representation
from .config import Config
from .posing import Splats
from .trainer import Trainer
from .views import TrainView

Progress = Callable[[dict[str, Any]], None]


def train(
    dataset_root: Path,
    folder: Path,
    config: Config,
    *,
    resume: bool = False,
    progress: Progress | None = None,
) -> checkpoint.Run:
    """Train a run folder from a data set.

    Args:
        dataset_root: The data set.
        folder: Run folder; made, or gone on with.
        config: Configuration; with ``resume`` the folder's own is used.
        resume: Go on from the last checkpoint; where training is finished, nothing is done.
        progress: Called with a dictionary per logged step.

    Returns:
        The run.

    Raises:
        DatasetError, CheckpointError, TrainingError: As their messages say.
        Interrupted: SIGINT or SIGTERM came; the checkpoint is written.
    """
    progress = progress or (lambda event: None)
    dataset = datasets.read(dataset_root)
    if resume and (Path(folder) / checkpoint.RUN_FILE).exists():
        run = checkpoint.open_run(folder)
        config = run.config
        if run.digest != dataset.digest:
            raise CheckpointError(
                f"{folder}: was trained on other data than {dataset_root} now holds; "
                "restore the data set or train into another folder"
            )
    else:
        resume = False
        run = checkpoint.create_run(folder, dataset, config)
    progress({"event": "start", "iterations": config.train.iterations, "dataset": str(dataset_root)})
    began = time.monotonic()
    state = None
    if resume and (run.folder / checkpoint.CHECKPOINT_FILE).exists():
        state = checkpoint.load(folder)
        if state.finished:
            progress({"event": "done", "gaussians": len(state.tensors["gaussians.means"])})
            return run
    trainer = Trainer(dataset, config)
    if state is not None:
        trainer.restore(state)
        _trim_log(run.folder / checkpoint.LOG_FILE, trainer.iteration)
        began -= state.seconds
    _optimise(trainer, run, began, progress)
    _finish(trainer, run, began, progress)
    progress({"event": "done", "gaussians": len(trainer.gaussians)})
    return run


def _optimise(trainer: Trainer, run: checkpoint.Run, began: float, progress: Progress) -> None:
    section = trainer.config.train
    last, last_time = trainer.iteration, time.monotonic()
    with (
        _signals() as asked,
        open(run.folder / checkpoint.LOG_FILE, "a", encoding="utf-8") as log,
    ):
        while not trainer.done:
            trainer.step()
            if trainer.iteration % section.log_every == 0 or trainer.done:
                now = time.monotonic()
                rate = (now - last_time) / max(1, trainer.iteration - last)
                last, last_time = trainer.iteration, now
                event = {
                    "event": "step",
                    "iteration": trainer.iteration,
                    "loss": trainer.running_loss,
                    "gaussians": len(trainer.gaussians),
                    "seconds": now - began,
                    "seconds_left": rate * (section.iterations - trainer.iteration),
                }
                log.write(json.dumps(event) + "\n")
                log.flush()
                progress(event)
            stop = bool(asked)
            if trainer.iteration % section.checkpoint_every == 0 or stop or trainer.done:
                _save(trainer, run, began, finished=False)
            if stop:
                raise Interrupted(
                    f"stopped at step {trainer.iteration}; go on with: r5dgs train {run.dataset_root} "
                    f"--out {run.folder} --resume"
                )


def _trim_log(path: Path, iteration: int) -> None:
    """Drop the lines of steps that were taken after the checkpoint and will be taken again."""
    if path.exists():
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.endswith("}")]
        kept = [line for line in lines if json.loads(line)["iteration"] <= iteration]
        files.write(path, "".join(line + "\n" for line in kept).encode())


def _finish(trainer: Trainer, run: checkpoint.Run, began: float, progress: Progress) -> None:
    """Labels and identity encodings on the finished geometry, then the last checkpoint."""
    classes = {int(i): row for row, i in enumerate(trainer.object_ids)}
    motion = trainer.motion.observed_motion(trainer.motion.tensors(), trainer.object_ids, trainer.places.measured)
    group_classes = representation.group_classes(motion.groups, trainer.object_ids)
    fallback = torch.from_numpy(group_classes)[trainer.gaussians.motion_ids]
    extra: dict[str, torch.Tensor] = {"labels": fallback}
    if any(v.mask is not None for v in trainer.views):

        @torch.no_grad()
        def pose(view: TrainView) -> Splats:
            return trainer.splats(view.camera, view.t)

        extra["labels"] = identity.vote(trainer.views, pose, classes, fallback)
        section = trainer.config.identity
        if section.iterations > 0 and len(classes) > 1:

            def report(step: int, loss: float) -> None:
                if step % trainer.config.train.log_every == 0 or step == section.iterations:
                    progress({"event": "identity", "iteration": step, "iterations": section.iterations, "loss": loss})

            # A generator of its own: a run resumed here draws what an unbroken one draws.
            draws = torch.Generator().manual_seed(trainer.config.train.seed + 1)
            encodings, weight, bias = identity.train_encodings(
                trainer.views, pose, classes, extra["labels"], section, draws, report
            )
            extra |= {"identities": encodings, "classifier.weight": weight, "classifier.bias": bias}
    _save(trainer, run, began, finished=True, extra=extra)


def _save(
    trainer: Trainer,
    run: checkpoint.Run,
    began: float,
    *,
    finished: bool,
    extra: dict[str, torch.Tensor] | None = None,
) -> None:
    state = trainer.state()
    tensors = {**state.tensors, **(extra or {})}
    seconds = time.monotonic() - began
    checkpoint.save(run.folder, dataclasses.replace(state, tensors=tensors, finished=finished, seconds=seconds))


@contextmanager
def _signals():
    """Collect SIGINT and SIGTERM instead of dying of them; a second one of the same kind kills."""
    asked: list[int] = []
    previous: dict[int, Any] = {}

    def note(number, frame):
        asked.append(number)
        signal.signal(number, previous[number])

    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            previous[number] = signal.signal(number, note)
    except ValueError:  # not the main thread: the caller handles signals
        previous.clear()
    try:
        yield asked
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
