"""Run folders: their files, and ``run.json`` with the configuration, data set, versions and platform.

A run folder contains ``run.json``, ``checkpoint.pt`` and ``checkpoint.previous.pt`` (see `checkpoint`), ``log.jsonl``
(one line per logged step) and ``learning_curves.png`` (plot of the log).
"""

from __future__ import annotations

import datetime
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import __version__, atomic_files, folder_lock, input_paths, strict_json
from ..config import config as configs
from ..config.config import Config
from ..data.dataset import Dataset
from ..errors import CheckpointError, ConfigError
from ..render import machine
from . import checkpoint
from .checkpoint import CHECKPOINT_FILE, PREVIOUS_FILE
from .checkpoint_content import FORMAT_VERSION

RUN_FILE = input_paths.RUN_FILE
LOG_FILE, EVALUATION_FILE, CURVES_FILE = "log.jsonl", "evaluation.json", "learning_curves.png"


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
    if not (folder / RUN_FILE).exists() or checkpoint.newest_file(folder) is None:
        return
    try:
        found = f"a run at step {checkpoint.load(folder).iteration}; add --resume to continue, or"
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
