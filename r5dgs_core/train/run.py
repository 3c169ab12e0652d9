"""Training run: steps, log, checkpoints and identity encodings. A resumed run equals an uninterrupted one."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import shlex
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import torch

from .. import atomic_files, folder_lock
from ..config import training_needs
from ..config.config import Config
from ..data import dataset as datasets
from ..errors import CheckpointError, Interrupted, TrainingError
from ..render import warm_up
from ..time_left import Phase, Timed
from . import checkpoint, checkpoint_content, interrupt, learning_curves, probe
from .identity import identity_training, label_cleanup, packed_masks
from .representations import registry
from .representations.fused_posing import Splats
from .train_views import TrainView
from .trainer import Trainer

log = logging.getLogger(__name__)

Progress = Callable[[dict[str, Any]], None]
# Costs of steps relative to training steps, measured on the kitchen scene; initial values of the time estimate.
DISCOVERY_COST = 1.9
TRIAL_COST = 2.5  # including the comparison of the bodies afterwards


def train(
    dataset_root: Path,
    folder: Path,
    config: Config,
    *,
    resume: bool = False,
    overwrite: bool = False,
    go_on: str | None = None,
    progress: Progress | None = None,
) -> checkpoint.Run:
    """Train a run folder from a data set.

    Args:
        dataset_root: The data set.
        folder: Run folder; created if it is missing.
        config: Configuration; ignored with ``resume``, which uses that of the folder.
        resume: Continue from the last checkpoint. Does nothing if training is finished.
        overwrite: Start again if the folder contains a run. Its files are kept until training is ready for the first
            step.
        go_on: Command that resumes this run, for messages; by default a call of ``r5dgs train``.
        progress: Called with a dictionary per event (docs/training.md). If it is a `Timed`, its estimate of the time
            left also counts phases that the caller has added.

    Returns:
        The run.

    Raises:
        DatasetError: The data set cannot be read or used.
        CheckpointError: The folder cannot be used, or its checkpoint is damaged or belongs to other data.
        TrainingError: A value is no longer finite, or no Gaussians are left.
        Interrupted: SIGINT or SIGTERM was received; the run can be resumed.
    """
    folder = Path(folder)
    with contextlib.ExitStack() as stack:

        def claim() -> None:
            if stack.enter_context(folder_lock.hold(folder)):  # no other process is writing to these files
                checkpoint.remove_leftovers(folder)

        timed = progress if isinstance(progress, Timed) else Timed(progress or (lambda event: None))
        return _train(dataset_root, folder, config, resume, overwrite, go_on, timed, claim)


def _train(
    dataset_root: Path,
    folder: Path,
    config: Config,
    resume: bool,
    overwrite: bool,
    go_on: str | None,
    progress: Timed,
    claim: Callable[[], None],
) -> checkpoint.Run:
    """Implementation of `train`; ``claim`` locks the folder."""
    is_new = not folder.is_dir()
    if not is_new:
        claim()
    if resume and not (folder / checkpoint.RUN_FILE).exists():
        log.warning("%s: no run to resume; starting a new one", folder)
        resume = False
    if not resume and not overwrite:
        checkpoint.refuse_to_lose(folder)
    settled = checkpoint.open_run(folder).config if resume else config
    dataset = datasets.read(dataset_root, settled.data.masks, settled.data.min_registered)
    dataset.require_one_numbering()
    if is_new:  # created only now, so that an unreadable data set leaves no folder
        checkpoint.plan_run(folder, dataset, config)
        claim()
        if not overwrite:
            checkpoint.refuse_to_lose(folder)  # another process may have created a run meanwhile
    go_on = go_on or shlex.join(["r5dgs", "train", str(Path(dataset.root).resolve()), "--out", str(folder), "--resume"])
    state, replaces = None, False
    if resume:
        run = checkpoint.open_run(folder)
        state = None if checkpoint.newest_file(folder) is None else checkpoint.load(folder, mend=True)
        if run.digest != dataset.digest and state is None:  # no step has used the other data yet
            run = checkpoint.create_run(folder, dataset, run.config)
        if run.digest != dataset.digest:
            raise CheckpointError(
                f"{folder}: was trained on other data than {dataset_root} now holds; "
                "restore the data set or train into another folder"
            )
    else:
        replaces = checkpoint.newest_file(folder) is not None
        run = (checkpoint.plan_run if replaces else checkpoint.create_run)(folder, dataset, config)
    iterations = run.config.train.iterations
    done = 0 if state is None else state.iteration
    progress({"event": "start", "iterations": iterations, "from": done, "dataset": str(dataset_root)})
    began = time.monotonic()
    if state is not None and state.finished:
        count = len(state.tensors["gaussians.means"])
        progress({"event": "trained", "gaussians": count, "text": "already finished"})
        return run
    kept = f"{folder} is as it was; give the same command to begin again" if replaces else f"go on with: {go_on}"
    with interrupt.at_once(f"stopped before the first step; {kept}" if state is None else f"stopped; {kept}"):
        progress({"event": "prepare", "text": "kernels"})
        warm_up.warm_up()
        found = _found_masks(dataset, run.config, state, progress)
        progress({"event": "prepare", "text": "images, objects, background"})
        trainer = Trainer(dataset, run.config, found)
        probe = _probe(trainer)
    if replaces:
        run = checkpoint.create_run(folder, dataset, config)
    if state is not None:
        trainer.restore(state)
        began -= state.seconds
    _clean_up(folder, trainer.iteration)
    pictures = learning_curves.Curves(run.folder)
    _plan(trainer, progress)
    _optimise(trainer, run, began, go_on, progress, probe, pictures)
    with interrupt.at_once(f"stopped after the last step, before the labels; go on with: {go_on}"):
        _finish(trainer, run, began, progress)
        pictures.update(finished=True)
    progress({"event": "trained", "gaussians": len(trainer.gaussians)})
    return run


def _found_masks(
    dataset: datasets.Dataset, config: Config, state: checkpoint.Checkpoint | None, progress: Timed
) -> list[np.ndarray] | None:
    """Return masks of moving objects for data without masks: those of the checkpoint, or newly discovered ones."""
    if state is None:
        if not training_needs.discovery(dataset, config):
            return None
        from . import object_discovery  # imported late: it loads the networks of the field

        progress.estimate.add(Phase(object_discovery.NAME, config.discovery.iterations, DISCOVERY_COST))
        progress.estimate.add(Phase("step", config.train.iterations))
        return object_discovery.find(dataset, config, progress)
    sizes = [(view.camera.height, view.camera.width) for view in dataset.train]
    return packed_masks.unpack(state.tensors[packed_masks.NAME], sizes) if packed_masks.NAME in state.tensors else None


def _plan(trainer: Trainer, progress: Timed) -> None:
    """Add the remaining phases of training to the estimate of the time left."""
    config, estimate = trainer.config, progress.estimate
    estimate.finish("discovery")  # `object_discovery.NAME`, without importing its networks
    estimate.add(Phase("step", config.train.iterations))
    estimate.at("step", trainer.iteration)
    decision = decision_step(trainer)
    if decision is not None and decision > trainer.iteration:
        from . import residual_trial

        estimate.add(Phase(residual_trial.TRIAL, residual_trial.trial_steps(config), TRIAL_COST))
    estimate.add(Phase("identity", _identity_steps(trainer)))


def decision_step(trainer: Trainer) -> int | None:
    """Return the step after which residuals are tried; None if never, as with a single observed time."""
    if not trainer.motion.takes_residuals or len(trainer.times) < 2:
        return None
    from . import residual_trial  # static scenes do not need it

    config = trainer.config
    return residual_trial.decision_step(config, config.curriculum.steps(config.train.iterations)[1])


def take_step(trainer: Trainer, decision: int | None, progress: Progress) -> None:
    """Take a step; if it is the step ``decision`` (see `decision_step`), try residuals after it."""
    trainer.step()
    if trainer.iteration == decision:
        from . import residual_trial

        residual_trial.decide(trainer, progress)


def _probe(trainer: Trainer) -> probe.Probe | None:
    """Return the probe of the held-out views; None if there are none or ``train.probe_every`` is 0."""
    section = trainer.config.train
    if section.probe_every == 0 or not trainer.dataset.val:
        return None
    return probe.Probe(trainer, section.probe_views)


def _optimise(
    trainer: Trainer,
    run: checkpoint.Run,
    began: float,
    go_on: str,
    progress: Timed,
    probe: probe.Probe | None,
    pictures: learning_curves.Curves,
) -> None:
    """Take the remaining steps, and write the log and checkpoints."""
    section = trainer.config.train
    path = run.folder / checkpoint.LOG_FILE
    decision = decision_step(trainer)
    with interrupt.collected() as asked, _open_log(path) as stream:
        while not trainer.done:
            take_step(trainer, decision, progress)
            look = probe is not None and (trainer.done or trainer.iteration % section.probe_every == 0)
            if trainer.iteration % section.log_every == 0 or trainer.done or look:
                event = {
                    "event": "step",
                    "iteration": trainer.iteration,
                    "loss": trainer.running_loss,
                    "gaussians": len(trainer.gaussians),
                    "seconds": time.monotonic() - began,
                }
                event = progress.timed(event)
                if look and probe is not None:
                    event["val_psnr"] = probe.psnr()
                _append(path, stream, event)
                progress(event)
            stop = bool(asked)
            if trainer.iteration % section.checkpoint_every == 0 or stop or trainer.done:
                _save(trainer, run, began, finished=False)
                pictures.update()
            if stop:
                raise Interrupted(f"stopped at step {trainer.iteration}; go on with: {go_on}")


def _identity_steps(trainer: Trainer) -> int:
    """Return the number of steps for identity encodings after the run; each costs about as much as a training step."""
    if trainer.config.identity.training != "after":
        return 0
    masked = any(view.mask is not None for view in trainer.views)
    return trainer.config.identity.iterations if masked and len(trainer.object_ids) > 1 else 0


def _open_log(path: Path) -> TextIO:
    try:
        return open(path, "a", encoding="utf-8")
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be written: {error}") from error


def _append(path: Path, stream: TextIO, event: dict[str, Any]) -> None:
    try:
        stream.write(json.dumps(event) + "\n")
        stream.flush()
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be written: {error}; make room and go on with --resume") from error


def _clean_up(folder: Path, iteration: int) -> None:
    """Drop incomplete lines of the log, and lines of steps that will be taken again."""
    path = folder / checkpoint.LOG_FILE
    kept = []
    try:
        if not path.exists():
            return
        for line in path.read_bytes().splitlines():
            event = _parse(line)
            if event is None or event["iteration"] > iteration:
                break
            kept.append(line + b"\n")
        atomic_files.write(path, b"".join(kept))
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be written: {error}") from error


def _parse(line: bytes) -> dict[str, Any] | None:
    """Return the event of a line of the log; None if the line is incomplete."""
    try:
        event = json.loads(line)
    except ValueError:
        return None
    return event if isinstance(event, dict) and isinstance(event.get("iteration"), int) else None


def _finish(trainer: Trainer, run: checkpoint.Run, began: float, progress: Timed) -> None:
    """Compute labels and identity encodings on the final geometry, and save the last checkpoint."""
    classes = {int(i): row for row, i in enumerate(trainer.object_ids)}
    group_classes = trainer.motion.group_classes(trainer.motion.tensors())
    fallback = torch.from_numpy(group_classes)[trainer.gaussians.motion_ids]
    extra: dict[str, torch.Tensor] = {"labels": fallback}
    if any(v.mask is not None for v in trainer.views):

        @torch.no_grad()
        def pose(view: TrainView) -> Splats:
            return trainer.splats(view.camera, view.t)

        progress({"event": "prepare", "text": "labels, by a vote of the masks"})
        votes = identity_training.votes(trainer.views, pose, classes, len(fallback))
        extra["labels"] = identity_training.elect(votes, fallback)
        steps = _identity_steps(trainer)
        if trainer.identity is not None:
            extra |= trainer.identity.outcome(trainer.gaussians)
        elif steps > 0:

            def report(step: int, loss: float) -> None:
                if step % trainer.config.train.log_every == 0 or step == steps:
                    progress({"event": "identity", "iteration": step, "iterations": steps, "loss": loss})

            # A separate generator, so that a run resumed here draws the same numbers.
            draws = torch.Generator().manual_seed(trainer.config.train.seed + 1)
            encodings, weight, bias = identity_training.train_encodings(
                trainer.views,
                pose,
                classes,
                extra["labels"],
                trainer.config,
                trainer.gaussians.means.detach(),
                draws,
                report,
            )
            extra |= {"identities": encodings, "classifier.weight": weight, "classifier.bias": bias}
        if trainer.config.identity.hygiene and len(classes) > 1:
            # After the encodings, which follow the edges of the masks; cleaned labels follow motion, too.
            extra |= _cleaned(trainer, votes, extra["labels"])
    elif trainer.motion.sorts_by_motion and training_needs.sorting(trainer.dataset, trainer.config):
        from . import object_discovery

        progress({"event": "prepare", "text": "no masks: sorting moving Gaussians into parts"})
        labels = torch.from_numpy(object_discovery.sort(trainer) + 1)
        count = int(labels.max())
        progress({"event": "prepare", "text": f"no masks: {count} moving part{'s' * (count != 1)} found"})
        extra |= {"labels": labels, "object_ids": torch.arange(count + 1), packed_masks.LABELS: labels}
    with torch.no_grad():
        shown = probe.training_psnr(
            trainer.dataset,
            trainer.behind,
            lambda view: trainer.render(trainer.normalization.camera(view.camera), view.t).numpy(),
        )
    extra[checkpoint_content.TRAIN_PSNR] = torch.tensor(shown, dtype=torch.float64)
    _save(trainer, run, began, finished=True, extra=extra)


def _cleaned(trainer: Trainer, votes: torch.Tensor, labels: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the cleaned labels and the counts of changes, by their names in the checkpoint."""
    given, ids = labels.numpy(), trainer.gaussians.motion_ids
    params = {name: tensor.detach() for name, tensor in trainer.gaussians.params.items()}
    tensors = {f"gaussians.{name}": tensor for name, tensor in params.items()} | trainer.motion.tensors()
    motion = registry.observed_motion(
        trainer.motion.name,
        tensors | {"gaussians.motion_ids": ids},
        trainer.object_ids,
        trainer.places.measured,
        given,
        trainer.config,
    )
    gaussians = {name: tensor.numpy() for name, tensor in params.items()} | (motion.gaussians or {})
    group_ids = ids.numpy() if motion.motion_ids is None else motion.motion_ids
    points = label_cleanup.bound(motion.groups, group_ids, gaussians["means"])
    going, moving = label_cleanup.companions(motion.groups, group_ids, points, trainer.object_ids)
    opacities = 1 / (1 + np.exp(-gaussians["opacity_logits"].astype(np.float64)))
    found, changes = label_cleanup.clean(votes.numpy(), given, points, opacities, going, moving)
    counts = dataclasses.astuple(changes)
    log.info("labels: %d by neighbours, %d by motion, %d outliers changed of %d", *counts)
    return {"labels": torch.from_numpy(found), label_cleanup.CHANGES: torch.tensor(counts)}


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
    if packed_masks.LABELS in tensors:  # objects found after the run count as observed at all times
        shape = len(tensors["object_ids"]) - 1, len(trainer.times)
        state = dataclasses.replace(state, observed=torch.ones(shape, dtype=torch.bool))
    values = {
        name: t for name, t in tensors.items() if t.is_floating_point() and name != checkpoint_content.RESIDUAL_GAINS
    }
    bad = [name for name, tensor in values.items() if not tensor.isfinite().all()]
    if bad:
        raise TrainingError(
            f"step {state.iteration}: {', '.join(bad)} is not finite; the last checkpoint is kept. "
            "Remedy: lower the learning rates (rates.*)"
        )
    seconds = time.monotonic() - began
    checkpoint.save(run.folder, dataclasses.replace(state, tensors=tensors, finished=finished, seconds=seconds))
