"""Checkpoints: named tensors and plain values, written atomically.

A run folder keeps the last state, ``checkpoint.pt``, and the state before it, ``checkpoint.previous.pt``.
"""

from __future__ import annotations

import dataclasses
import logging
import os
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from ..errors import CheckpointError
from . import checkpoint_content, checkpoint_file
from .checkpoint_content import FORMAT_VERSION

log = logging.getLogger(__name__)

CHECKPOINT_FILE, PREVIOUS_FILE = GENERATIONS = "checkpoint.pt", "checkpoint.previous.pt"


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
