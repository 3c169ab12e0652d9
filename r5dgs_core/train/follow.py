"""Processes of a run that do not lead it: they take the same steps and write no files."""

from __future__ import annotations

import logging
from pathlib import Path

from ..data import dataset as datasets
from ..errors import DatasetError, Interrupted
from ..render import warm_up
from . import devices, interrupt, run
from .trainer import Trainer
from .workers import Workers


def follow(dataset_root: Path, workers: Workers) -> None:
    """Take the steps of a run that another process leads.

    Args:
        dataset_root: The data set.
        workers: The processes.

    Raises:
        DatasetError: The data set differs from that of the leading process.
        Interrupted: One of the processes was asked to stop.
        TrainingError: Another process has ended, or has another state than this one.
    """
    logging.disable(logging.WARNING)  # the leading process warns
    begin = workers.broadcast(None)
    if begin is None:  # the run is already finished
        return
    config, digest, found, state = begin
    dataset = datasets.read(dataset_root, config.data.masks, config.data.min_registered)
    if dataset.digest != digest:
        raise DatasetError(
            f"{dataset_root}: differs from the data of the first process; give all processes the same files"
        )
    if devices.select(config.train.device).type == devices.CPU:
        warm_up.warm_up()
    trainer = Trainer(dataset, config, found, workers, state)
    if state is not None:
        trainer.restore(state)
    decision = run.decision_step(trainer)
    with interrupt.collected() as asked:
        while not trainer.done:
            run.take_step(trainer, decision, lambda event: None)
            if workers.any(bool(asked)):
                raise Interrupted(f"stopped at step {trainer.iteration}, with the other processes of the run")
