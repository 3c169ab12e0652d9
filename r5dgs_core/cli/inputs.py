"""Targets, data sets and playback modes that several commands take: checks of arguments, and opening."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from .. import errors, input_paths
from ..playback import modes

if TYPE_CHECKING:
    from ..data.dataset import Dataset
    from ..scene.scene import Scene

log = logging.getLogger(__name__)


def check_dataset(root: Path) -> None:
    """Raise `DatasetError` if a path is not a data set folder in a known layout."""
    from ..data.layouts import registry

    registry.check(root)


def check_target(target: Path, data: Path | None) -> None:
    """Raise R5dgsError if the target is neither a run folder nor a file, or if ``data`` is not a data set."""
    input_paths.check_target(target)
    if data is not None:
        check_dataset(data)


def check_mode(mode: str, scene: Scene | None = None, place: object = "") -> None:
    """Raise UsageError for an unknown playback mode, or ConfigError if the scene at ``place`` has no data for it."""
    try:
        modes.split(mode)
    except ValueError:
        raise errors.UsageError(f"--mode {mode}: expected one of {', '.join(modes.every())}") from None
    if scene is None:
        return
    from ..playback import scene_player

    if not scene_player.available(scene, mode):
        raise errors.ConfigError(f"--mode {mode}: {place} has data for {', '.join(scene_player.modes(scene))} only")


def open_target(target: Path, data: Path | None) -> tuple[Scene, Dataset | None]:
    """Return the scene of a run folder or scene file, and its data set; for a file, only if ``data`` is given."""
    from ..bake import bake
    from ..data import dataset as datasets
    from ..scene import scene_file
    from ..train import run_folder

    if target.is_dir():
        run = run_folder.open_run(target)
        dataset = datasets.read(run.data(data), run.config.data.masks, run.config.data.min_registered)
        scene, trained_on = bake.bake(run, dataset), run.digest
    else:
        scene = scene_file.read(target)
        dataset = None if data is None else datasets.read(data, min_registered=0.0)
        trained_on = scene.provenance.get("dataset_digest")
    if dataset is not None and trained_on is not None and trained_on != dataset.digest:
        log.warning("%s: differs from the data that %s was trained on; it is used anyway", dataset.root, target)
    return scene, None if dataset is None else dataset.relative_to(scene.origin)
