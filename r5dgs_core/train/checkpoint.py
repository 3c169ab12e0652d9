"""Run folders and checkpoints: named tensors and plain values, written whole or not at all.

A run folder holds ``run.json`` (configuration, data set, versions), ``checkpoint.pt`` (the last state) and
``log.jsonl`` (one line per logged step).
"""

from __future__ import annotations

import json
import os
import platform
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .. import __version__
from ..data.dataset import Dataset
from ..errors import CheckpointError
from . import config as configs
from .config import Config

FORMAT_VERSION = 1
RUN_FILE, CHECKPOINT_FILE, LOG_FILE = "run.json", "checkpoint.pt", "log.jsonl"


@dataclass(frozen=True)
class Run:
    """What ``run.json`` says.

    Attributes:
        folder: The run folder.
        dataset_root: Where the data set was.
        digest: Hash of the data set's content.
        config: Configuration of the run.
        versions: Versions of what it ran on.
    """

    folder: Path
    dataset_root: Path
    digest: str
    config: Config
    versions: dict[str, str]


def versions() -> dict[str, str]:
    """Versions that a result may depend on."""
    import numba

    return {
        "r5dgs": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "numba": numba.__version__,
    }


def create_run(folder: Path, dataset: Dataset, config: Config) -> Run:
    """Make a run folder and write its ``run.json``.

    Raises:
        CheckpointError: The folder exists and holds something else than a run.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or (any(folder.iterdir()) and not (folder / RUN_FILE).exists())):
        raise CheckpointError(f"{folder}: exists and is not a run folder; choose another --out")
    folder.mkdir(parents=True, exist_ok=True)
    for old in (CHECKPOINT_FILE, LOG_FILE):
        (folder / old).unlink(missing_ok=True)
    run = Run(folder, Path(dataset.root).resolve(), dataset.digest, config, versions())
    text = {
        "format_version": FORMAT_VERSION,
        "dataset": str(run.dataset_root),
        "digest": run.digest,
        "config": config.to_dict(),
        "versions": run.versions,
    }
    write_atomic(folder / RUN_FILE, json.dumps(text, indent=2).encode())
    return run


def open_run(folder: Path) -> Run:
    """Read a run folder's ``run.json``.

    Raises:
        CheckpointError: There is none, or it is damaged or of another version.
    """
    path = Path(folder) / RUN_FILE
    try:
        text = json.loads(path.read_text(encoding="utf-8"))
        version = text["format_version"]
        if version != FORMAT_VERSION:
            raise CheckpointError(f"{path}: expected format_version {FORMAT_VERSION}, got {version}")
        return Run(
            Path(folder),
            Path(text["dataset"]),
            text["digest"],
            configs.from_dict(text["config"]),
            text["versions"],
        )
    except FileNotFoundError:
        raise CheckpointError(f"{folder}: not a run folder (no {RUN_FILE}); make one with 'r5dgs train'") from None
    except (ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"{path}: damaged ({type(error).__name__}: {error}); train again") from None


def save(folder: Path, state: dict[str, Any]) -> None:
    """Replace the checkpoint of a run; the old one stays until the new one is whole on the disk."""
    path = Path(folder) / CHECKPOINT_FILE
    temporary = path.with_suffix(".tmp")
    with open(temporary, "wb") as stream:
        torch.save({"format_version": FORMAT_VERSION, **state}, stream)
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(temporary, path)


def load(folder: Path) -> dict[str, Any]:
    """Read the checkpoint of a run.

    Raises:
        CheckpointError: There is none, or it is damaged or of another version.
    """
    path = Path(folder) / CHECKPOINT_FILE
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no checkpoint yet; train without --resume") from None
    except Exception as error:  # torch raises many kinds for a damaged file
        raise CheckpointError(f"{path}: damaged ({type(error).__name__}); train again") from error
    if not isinstance(state, dict) or state.get("format_version") != FORMAT_VERSION:
        raise CheckpointError(f"{path}: expected a checkpoint of format_version {FORMAT_VERSION}")
    return state


def write_atomic(path: Path, data: bytes) -> None:
    """Write a file under a temporary name and rename it."""
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_bytes(data)
    os.replace(temporary, path)
