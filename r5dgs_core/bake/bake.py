"""Bake a checkpoint into a scene: bind state at t_max, tracks in world coordinates, and a motion model per group."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from ..config import config as configs
from ..data import dataset as datasets
from ..data.dataset import Dataset
from ..errors import CheckpointError
from ..scene import scene_file
from ..scene.scene import Scene
from ..train import run_folder
from . import assemble, contact, hulls, needs, parts, point_motion, provenance, read_checkpoint, simplify_motion
from .draft import Stage

STAGES: tuple[Stage, ...] = (point_motion, simplify_motion, parts, hulls, contact, needs, provenance)


def bake(run: run_folder.Run, dataset: Dataset | None = None) -> Scene:
    """Bake the last checkpoint of a run into a scene.

    Args:
        run: A run folder; its training may be unfinished.
        dataset: The data set; read from the place recorded in the run if None.

    Returns:
        The scene, in the world coordinates of the data set.

    Raises:
        CheckpointError, DatasetError: A file is missing or damaged.
    """
    context = read_checkpoint.open_context(run, dataset)
    draft = assemble.draft(read_checkpoint.observe(context), context)
    for stage in STAGES:
        draft = stage.apply(draft, context)
    return draft.scene


def run_bake(folder: Path, out: Path, dataset_root: Path | None = None, overrides: Sequence[str] = ()) -> Scene:
    """Bake a run folder, write the scene file and return the scene.

    Args:
        folder: The run folder.
        out: Path of the scene file.
        dataset_root: The data set; None if it has not moved since training.
        overrides: ``needs.NAME=on|off`` overrides of the run's configuration.

    Raises:
        CheckpointError: The checkpoint is missing or damaged, or the data set is not the one of the training.
        ConfigError, UsageError: An override is invalid.
        DatasetError, SceneFileError: The data set cannot be read, or the scene file cannot be written.
    """
    run = run_folder.open_run(folder)
    configs.require_needs(overrides)
    run = dataclasses.replace(run, config=run.config.override(overrides))
    dataset = datasets.read(run.data(dataset_root), run.config.data.masks, run.config.data.min_registered)
    if dataset.digest != run.digest:
        raise CheckpointError(
            f"{dataset.root}: is not the data that {folder} was trained on, or was changed since; "
            "give that data with --data, or train again"
        )
    scene = bake(run, dataset)
    scene_file.write(scene, out)
    return scene
