"""Training run: steps, log, checkpoints and identity encodings. A resumed run equals an uninterrupted one."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .. import folder_lock
from ..config import training_needs
from ..config.config import Config
from ..data import dataset as datasets
from ..data import memory
from ..errors import CheckpointError, Interrupted, TrainingError
from ..render import warm_up
from ..time_left import Phase, TimedProgress
from . import (
    checkpoint,
    checkpoint_content,
    devices,
    finish,
    interrupt,
    learning_curves,
    run_folder,
    step_log,
    view_psnr,
)
from .identity import packed_masks
from .refinement import trial
from .representations.representation import TRACKS
from .trainer import Trainer
from .workers import ALONE, Workers, launch_command, on_this_machine

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
    device: str | None = None,
    resume_command: str | None = None,
    progress: Progress | None = None,
    workers: Workers = ALONE,
) -> run_folder.Run:
    """Train a run folder from a data set.

    Args:
        dataset_root: The data set.
        folder: Run folder; created if it is missing.
        config: Configuration; ignored with ``resume``, which uses that of the folder.
        resume: Continue from the last checkpoint. Does nothing if training is finished.
        overwrite: Start again if the folder contains a run. Its files are kept until training is ready for the first
            step.
        device: Device for this session, as ``train.device``, which it replaces; a run may be resumed on another device.
        resume_command: Command that resumes this run, for messages; by default a call of ``r5dgs train``.
        progress: Called with a dictionary per event (docs/reference/run_folder.md#progress). If it is a
            `TimedProgress`, its estimate of the time left also counts phases that the caller has added.
        workers: Processes that train together, of which this one leads; the others call `follow.follow`.

    Returns:
        The run.

    Raises:
        DatasetError: The data set cannot be read or used.
        CheckpointError: The folder cannot be used, or its checkpoint is damaged or belongs to other data.
        TrainingError: A value is no longer finite, or no Gaussians are left.
        Interrupted: SIGINT or SIGTERM was received; the run can be resumed.
    """
    if device is not None:
        config = config.replace(**{"train.device": device})
    request = _Request(dataset_root, Path(folder), config, resume, overwrite, device, resume_command, workers)
    with contextlib.ExitStack() as stack:

        def claim() -> None:
            if stack.enter_context(folder_lock.hold(request.folder)):  # no other process is writing to these files
                run_folder.remove_leftovers(request.folder)

        timed = progress if isinstance(progress, TimedProgress) else TimedProgress(progress or (lambda event: None))
        return _train(request, timed, claim)


@dataclass(frozen=True)
class _Request:
    """Arguments of `train`."""

    dataset_root: Path
    folder: Path
    config: Config
    resume: bool
    overwrite: bool
    device: str | None
    resume_command: str | None
    workers: Workers


@dataclass(frozen=True)
class _Session:
    """A run that this process trains.

    Attributes:
        run: The run folder.
        trainer: Its trainer.
        began: Reading of the wall clock at the start of training, minus the time of earlier sessions, s.
        began_cpu: The same for the processor clock; None if the log of an older version has no processor time.
        resume_command: Command that resumes the run, for messages.
        progress: Called with a dictionary per event.
        held_out: Measurement of the PSNR on held-out views, or None.
        curves: Plot of the log.
    """

    run: run_folder.Run
    trainer: Trainer
    began: float
    began_cpu: float | None
    resume_command: str
    progress: TimedProgress
    held_out: view_psnr.HeldOutPsnr | None
    curves: learning_curves.LearningCurves


def _train(request: _Request, progress: TimedProgress, claim: Callable[[], None]) -> run_folder.Run:
    """Implementation of `train`; ``claim`` locks the folder."""
    request, dataset = _prepare(request, claim)
    folder, resume_command = request.folder, request.resume_command
    if resume_command is None:
        arguments = ["train", str(Path(dataset.root).resolve()), "--out", str(folder), "--resume"]
        resume_command = launch_command(request.workers.count, arguments)
    run, state, replaces = _open(request, dataset)
    done = 0 if state is None else state.iteration
    start = {"event": "start", "iterations": run.config.train.iterations, "from": done}
    progress({**start, "dataset": str(request.dataset_root)})
    began, began_cpu = time.monotonic(), time.process_time()
    if state is not None and state.finished:
        count = len(state.tensors["gaussians.means"])
        progress({"event": "trained", "gaussians": count, "text": "already finished"})
        request.workers.broadcast(None)
        return run
    kept = f"continue with: {resume_command}"
    if replaces:
        kept = f"{folder} is unchanged; repeat the same command to start again"
    with interrupt.at_once(f"stopped before the first step; {kept}" if state is None else f"stopped; {kept}"):
        device = devices.select(run.config.train.device)
        if device.type == devices.CPU:
            progress({"event": "prepare", "text": "kernels"})
            warm_up.warm_up()
        else:
            progress({"event": "prepare", "text": f"training on {devices.title(device)}"})
        found = _found_masks(dataset, run.config, state, progress)
        note = memory.note(dataset, run.config.data.memory, on_this_machine())
        progress({"event": "prepare", "text": f"images, objects, background{note}"})
        request.workers.broadcast((run.config, dataset.digest, found, state))
        trainer = Trainer(dataset, run.config, found, request.workers, state)
        held_out = view_psnr.configured(trainer)
    if replaces:
        run = run_folder.create_run(folder, dataset, request.config)
    if state is not None:
        trainer.restore(state)
        began -= state.seconds
    step_log.clean_up(folder / run_folder.LOG_FILE, trainer.iteration)
    began_cpu = step_log.processor_start(folder / run_folder.LOG_FILE, began_cpu)
    curves = learning_curves.LearningCurves(run.folder)
    _plan(trainer, progress)
    _complete(_Session(run, trainer, began, began_cpu, resume_command, progress, held_out, curves))
    return run


def _prepare(request: _Request, claim: Callable[[], None]) -> tuple[_Request, datasets.Dataset]:
    """Lock the folder and read the data set; return the request, without ``resume`` if there is no run to resume."""
    folder = request.folder
    is_new = not folder.is_dir()
    if not is_new:
        claim()
    if request.resume and not (folder / run_folder.RUN_FILE).exists():
        log.warning("%s: no run to resume; starting a new one", folder)
        request = dataclasses.replace(request, resume=False)
    if not request.resume and not request.overwrite:
        run_folder.refuse_to_lose(folder)
    settled = run_folder.open_run(folder).config if request.resume else request.config
    dataset = datasets.read(request.dataset_root, settled.data.masks, settled.data.min_registered)
    dataset.require_one_numbering()
    memory.check_images(dataset, on_this_machine())
    if is_new:  # created only now, so that an unreadable data set leaves no folder
        run_folder.plan_run(folder, dataset, request.config)
        claim()
        if not request.overwrite:
            run_folder.refuse_to_lose(folder)  # another process may have created a run meanwhile
    return request, dataset


def _open(request: _Request, dataset: datasets.Dataset) -> tuple[run_folder.Run, checkpoint.Checkpoint | None, bool]:
    """Return the run, its last state or None, and True if the files of an earlier run are still to be replaced."""
    folder = request.folder
    if not request.resume:
        replaces = checkpoint.newest_file(folder) is not None
        return (
            (run_folder.plan_run if replaces else run_folder.create_run)(folder, dataset, request.config),
            None,
            replaces,
        )
    run = run_folder.open_run(folder)
    if request.device is not None:
        run = dataclasses.replace(run, config=run.config.replace(**{"train.device": request.device}))
    state = None if checkpoint.newest_file(folder) is None else checkpoint.load(folder, mend=True)
    if run.digest != dataset.digest and state is None:  # no step has used the other data yet
        run = run_folder.create_run(folder, dataset, run.config)
    if run.digest != dataset.digest:
        raise CheckpointError(
            f"{folder}: was trained on other data than {request.dataset_root} now holds; "
            "restore the data set or train into another folder"
        )
    return run, state, False


def _found_masks(
    dataset: datasets.Dataset, config: Config, state: checkpoint.Checkpoint | None, progress: TimedProgress
) -> Sequence[np.ndarray] | None:
    """Return masks of moving objects for data without masks: those of the checkpoint, or newly discovered ones."""
    if state is None:
        if not training_needs.discovery(dataset, config):
            return None
        from . import object_discovery  # imported late: it loads the networks of the field

        progress.estimate.add(Phase(packed_masks.PHASE, config.discovery.iterations, DISCOVERY_COST))
        progress.estimate.add(Phase("step", config.train.iterations))
        return object_discovery.find_masks(dataset, config, progress)
    packed = state.tensors.get(checkpoint_content.DISCOVERED_MASKS)
    sizes = [(view.camera.height, view.camera.width) for view in dataset.train]
    return None if packed is None else packed_masks.unpack(packed, sizes)


def _plan(trainer: Trainer, progress: TimedProgress) -> None:
    """Add the remaining phases of training to the estimate of the time left."""
    config, estimate = trainer.config, progress.estimate
    estimate.finish(packed_masks.PHASE)
    estimate.add(Phase("step", config.train.iterations))
    estimate.at("step", trainer.iteration)
    decision = decision_step(trainer)
    if decision is not None and decision > trainer.iteration:
        from . import residual_trial

        estimate.add(Phase(residual_trial.TRIAL, residual_trial.trial_steps(config), TRIAL_COST))
    estimate.add(Phase("identity", finish.identity_steps(trainer)))


def decision_step(trainer: Trainer) -> int | None:
    """Return the step after which residuals are tried; None if they never are, such as with one observed time."""
    if not trainer.motion.takes_residuals or len(trainer.times) < 2:
        return None
    from . import residual_trial  # static scenes do not need it

    config = trainer.config
    return residual_trial.decision_step(config, config.curriculum.steps(config.train.iterations)[1])


def take_step(trainer: Trainer, decision: int | None, progress: Progress) -> None:
    """Take a step, then repair poses if due; after the step ``decision`` (see `decision_step`), try residuals."""
    entered = trainer.curriculum.entered
    trainer.step()
    if trainer.motion.name == TRACKS:
        from . import pose_repair  # a scene at rest does not load the tracks

        pose_repair.after_step(trainer, entered)
    trial.after_step(trainer)
    if trainer.iteration == decision:
        from . import residual_trial

        residual_trial.decide(trainer, progress)


def _complete(session: _Session) -> None:
    """Take the remaining steps, and store the final state with labels and identities."""
    trainer = session.trainer
    _optimise(session)
    stopped = "stopped after the last step, before the labels"
    with interrupt.at_once(f"{stopped}; continue with: {session.resume_command}"):
        _save(session, finished=True, extra=finish.final_tensors(trainer, session.progress))
        session.curves.update(finished=True)
    session.progress({"event": "trained", "gaussians": len(trainer.gaussians)})


def _optimise(session: _Session) -> None:
    """Take the remaining steps, and write the log and checkpoints."""
    trainer, held_out = session.trainer, session.held_out
    section = trainer.config.train
    decision = decision_step(trainer)
    with interrupt.collected() as asked, step_log.StepLog(session.run.folder / run_folder.LOG_FILE) as steps:
        while not trainer.done:
            take_step(trainer, decision, session.progress)
            due = held_out is not None and (trainer.done or trainer.iteration % section.probe_every == 0)
            if trainer.iteration % section.log_every == 0 or trainer.done or due:
                event = {
                    "event": "step",
                    "iteration": trainer.iteration,
                    "loss": trainer.running_loss,
                    "gaussians": len(trainer.gaussians),
                    "seconds": time.monotonic() - session.began,
                }
                if session.began_cpu is not None:
                    event["cpu_seconds"] = time.process_time() - session.began_cpu
                event = session.progress.timed(event)
                if due and held_out is not None:
                    event["val_psnr"] = held_out.measure()
                steps.append(event)
                session.progress(event)
            stop = trainer.workers.any(bool(asked))
            if trainer.iteration % section.checkpoint_every == 0 or stop or trainer.done:
                _save(session, finished=False)
                session.curves.update()
            if stop:
                raise Interrupted(f"stopped at step {trainer.iteration}; continue with: {session.resume_command}")


def _save(session: _Session, *, finished: bool, extra: dict[str, torch.Tensor] | None = None) -> None:
    """Write a checkpoint of the current state, with ``extra`` tensors."""
    trainer = session.trainer
    state = trainer.state()
    tensors = {**state.tensors, **(extra or {})}
    if checkpoint_content.DISCOVERED_LABELS in tensors:  # objects found after the run count as observed at all times
        shape = len(tensors["object_ids"]) - 1, len(trainer.times)
        state = dataclasses.replace(state, observed=torch.ones(shape, dtype=torch.bool))
    may_be_nan = checkpoint_content.MAY_BE_NAN
    values = {name: t for name, t in tensors.items() if t.is_floating_point() and name not in may_be_nan}
    bad = [name for name, tensor in values.items() if not tensor.isfinite().all()]
    if bad:
        raise TrainingError(
            f"step {state.iteration}: not finite: {', '.join(bad)}; the last checkpoint is kept. "
            "Remedy: lower the learning rates (rates.*)"
        )
    seconds = time.monotonic() - session.began
    checkpoint.save(session.run.folder, dataclasses.replace(state, tensors=tensors, finished=finished, seconds=seconds))
