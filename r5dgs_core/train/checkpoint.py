"""Run folders and checkpoints: named tensors and plain values, written atomically.

A run folder contains ``run.json`` (configuration, data set, versions, platform), ``checkpoint.pt`` (the last state),
``checkpoint.previous.pt`` (the state before it), ``log.jsonl`` (one line per logged step) and ``learning_curves.png``
(plot of the log).
"""

from __future__ import annotations

import dataclasses
import datetime
import json
import logging
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from .. import __version__, atomic_files, folder_lock, input_paths, strict_json
from ..config import config as configs
from ..config.config import Config
from ..data.dataset import Dataset
from ..errors import CheckpointError, ConfigError
from ..render import machine
from . import checkpoint_content, checkpoint_file
from .checkpoint_content import FORMAT_VERSION

log = logging.getLogger(__name__)

RUN_FILE = input_paths.RUN_FILE
LOG_FILE, EVALUATION_FILE, CURVES_FILE = "log.jsonl", "evaluation.json", "learning_curves.png"
CHECKPOINT_FILE, PREVIOUS_FILE = GENERATIONS = "checkpoint.pt", "checkpoint.previous.pt"


@dataclass(frozen=True)
class Run:
    """Content of ``run.json``.

    Attributes:
        folder: The run folder.
        dataset_root: Location of the data set at the start of the run.
        digest: Hash of the data set's content.
        config: Configuration of the run.
        versions: Versions of Python and packages.
        platform: Hardware that timings depend on, as from `render.machine.describe`; empty if unknown.
    """

    folder: Path
    dataset_root: Path
    digest: str
    config: Config
    versions: dict[str, str]
    platform: dict[str, Any]

    def data(self, given: Path | None = None) -> Path:
        """Return the location of the data set: ``given``, or else the recorded one.

        Raises:
            CheckpointError: ``given`` is None and the recorded location no longer exists.
        """
        if given is None and not self.dataset_root.is_dir():
            raise CheckpointError(
                f"{self.folder}: its data set was in {self.dataset_root}, which no longer exists; "
                "give its new location with --data DIR"
            )
        return given if given is not None else self.dataset_root


@dataclass(frozen=True)
class Checkpoint:
    """State that the next step and `bake` depend on.

    Attributes:
        tensors: Tensors by name: ``gaussians.NAME`` of N Gaussians, ``object_ids`` [B] (0 first), ``background`` [Kb,
            3], those of the representation, of the optimizer (``adam.NAME.MOMENT``) and of the densification
            (``gradients.NAME``), and the state of the ``generator``. A finished run also has ``labels`` [N] and, if
            there are masks, ``identities`` [N, 16] with ``classifier.weight`` and ``classifier.bias``.
        representation: Name of the representation, as in the configuration.
        iteration: Steps taken.
        entered: Indices of the first and the last observed time in training.
        first_time: Index of the time that training began with.
        queue: Views still to be drawn, the next one last.
        running_loss: Smoothed loss, nan before the first step.
        origin: World point at the origin of training coordinates. [3]
        scale: World units per unit of training coordinates.
        observed: Times at which the masks determine the pose of each object. [B - 1, S] bool
        finished: True if labels and identities are complete, too.
        seconds: Wall time of training, over all resumed sessions.
    """

    tensors: dict[str, Tensor]
    representation: str
    iteration: int
    entered: tuple[int, int]
    first_time: int
    queue: tuple[int, ...]
    running_loss: float
    origin: tuple[float, float, float]
    scale: float
    observed: Tensor
    finished: bool = False
    seconds: float = 0.0


def plan_run(folder: Path, dataset: Dataset, config: Config) -> Run:
    """Return the run that `create_run` would create, without writing anything.

    Raises:
        CheckpointError: The folder exists and is not a run folder.
    """
    folder = Path(folder)
    try:
        # Files that a process killed at the very start leaves behind.
        half_written = [*atomic_files.leftovers(folder / RUN_FILE), folder / folder_lock.LOCK_FILE]
        foreign = folder.exists() and (
            not folder.is_dir()
            or (not (folder / RUN_FILE).exists() and any(path not in half_written for path in folder.iterdir()))
        )
    except OSError as error:
        raise CheckpointError(f"{folder}: cannot be read: {error}; choose another --out") from error
    if foreign:
        raise CheckpointError(f"{folder}: exists and is not a run folder; choose another --out")
    return Run(folder, Path(dataset.root).resolve(), dataset.digest, config, machine.versions(), machine.describe())


def create_run(folder: Path, dataset: Dataset, config: Config) -> Run:
    """Create a run folder, or delete the files of an earlier run in it, and write ``run.json``.

    Raises:
        CheckpointError: The folder exists and is not a run folder, or cannot be written.
    """
    run = plan_run(folder, dataset, config)
    text = {
        "format_version": FORMAT_VERSION,
        "dataset": str(run.dataset_root),
        "digest": run.digest,
        "config": config.to_dict(),
        "versions": run.versions,
        "platform": run.platform,
        "begun": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    try:
        run.folder.mkdir(parents=True, exist_ok=True)
        # The newest checkpoint is deleted after the previous one, so that a kill in between keeps the old run.
        for name in (PREVIOUS_FILE, CHECKPOINT_FILE, LOG_FILE, EVALUATION_FILE, CURVES_FILE):
            (run.folder / name).unlink(missing_ok=True)
        atomic_files.write(run.folder / RUN_FILE, json.dumps(text, indent=2).encode())
    except OSError as error:
        raise CheckpointError(f"{run.folder}: cannot be created or written: {error}; choose another --out") from error
    return run


def remove_leftovers(folder: Path) -> None:
    """Remove partly written files of a killed process; the caller must hold the folder's lock.

    Raises:
        CheckpointError: A file cannot be removed.
    """
    for name in (RUN_FILE, CHECKPOINT_FILE, LOG_FILE, EVALUATION_FILE, CURVES_FILE):
        for path in atomic_files.leftovers(Path(folder) / name):
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                raise CheckpointError(f"{path}: cannot be removed: {error}") from error


def refuse_to_lose(folder: Path) -> None:
    """Raise `CheckpointError` if the folder contains a run that a new one would replace."""
    folder = Path(folder)
    if not (folder / RUN_FILE).exists() or newest_file(folder) is None:
        return
    try:
        found = f"a run at step {load(folder).iteration}; add --resume to continue, or"
    except CheckpointError:
        found = "a run whose checkpoint cannot be read; add"
    raise CheckpointError(f"{folder}: holds {found} --overwrite to start again")


def open_run(folder: Path) -> Run:
    """Read a run folder's ``run.json``.

    Raises:
        CheckpointError: The file is missing, damaged or of another version.
    """
    path = Path(folder) / RUN_FILE
    input_paths.check_run(Path(folder))
    text = strict_json.read(path, CheckpointError, "train again with --overwrite")
    try:
        found, made_by = text["format_version"], text["versions"]
        place, digest, settings = Path(text["dataset"]), text["digest"], text["config"]
        ran_on = dict(text.get("platform", {}))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise CheckpointError(
            f"{path}: damaged ({type(error).__name__}: {error}); train again with --overwrite"
        ) from None
    if found != FORMAT_VERSION:
        raise CheckpointError(
            f"{path}: expected format_version {FORMAT_VERSION}, got {found}; train again with --overwrite, "
            "or use the version of r5dgs that made it"
        )
    try:
        return Run(Path(folder), place, digest, configs.from_dict(settings), made_by, ran_on)
    except (ConfigError, AttributeError) as error:
        by = made_by.get("r5dgs", "another version") if isinstance(made_by, dict) else "another version"
        raise CheckpointError(
            f"{path}: the configuration is not one of r5dgs {__version__} (made by {by}): {error}; "
            "train again with --overwrite, or use the version that made it"
        ) from error


def newest_file(folder: Path) -> Path | None:
    """Return the newest checkpoint file of a run, even if it is damaged; None if there is none yet."""
    return next((path for name in GENERATIONS if (path := Path(folder) / name).exists()), None)


def save(folder: Path, state: Checkpoint) -> None:
    """Save a state as the newest checkpoint of a run; the former newest becomes the previous one.

    At least one complete checkpoint exists at any moment, even after a kill.

    Raises:
        CheckpointError: The file cannot be written.
    """
    path, previous = (Path(folder) / name for name in GENERATIONS)
    content = {f.name: getattr(state, f.name) for f in dataclasses.fields(state)}
    try:
        checkpoint_file.write(path, {"format_version": FORMAT_VERSION, **content}, previous)
    except OSError as error:
        raise CheckpointError(
            f"{path}: cannot be written: {error}; the previous checkpoint is kept. "
            "Free disk space and continue with --resume"
        ) from error


def load(folder: Path, *, mend: bool = False) -> Checkpoint:
    """Read the newest intact checkpoint of a run; a warning is logged if that is the previous one.

    Args:
        folder: The run folder.
        mend: Replace a damaged newest checkpoint by the previous one, so that `save` keeps it. The caller must hold the
            folder's lock.

    Raises:
        CheckpointError: There is no checkpoint, or both are damaged, incomplete or of another version.
    """
    path, previous = (Path(folder) / name for name in GENERATIONS)
    if newest_file(folder) is None:
        raise CheckpointError(f"{path}: no checkpoint yet; continue with 'r5dgs train ... --resume'")
    try:
        return read(path)
    except CheckpointError as error:
        if isinstance(error.__cause__, PermissionError):  # the file may be intact
            raise
        try:
            state = read(previous)
        except CheckpointError as other:
            also = f"; {other}" if previous.exists() else ""
            raise CheckpointError(f"{error}{also}; train again with --overwrite") from error
        log.warning("%s; using the previous checkpoint, %s of step %d", error, previous.name, state.iteration)
    if mend:
        try:
            os.replace(previous, path)
        except OSError as error:
            raise CheckpointError(f"{path}: cannot be replaced by {previous.name}: {error}") from error
    return state


def read(path: Path) -> Checkpoint:
    """Read one checkpoint file. Raises `CheckpointError` without a remedy."""
    try:
        return Checkpoint(**checkpoint_content.check(checkpoint_file.read(path)))
    except FileNotFoundError:
        raise CheckpointError(f"{path}: missing") from None
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error}") from error
    except checkpoint_file.DamagedError as error:
        raise CheckpointError(f"{path}: damaged ({error})") from error
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from None
