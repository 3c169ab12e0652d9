"""How Gaussians move in the observed time: the border that every representation keeps.

The trainer knows only `Representation`: splats at a time, what to optimise, a penalty, upkeep, and named tensors for
the checkpoint. `tracks` moves Gaussians by one SE(3) track per object; a deformation field is another class with the
same face.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from ..errors import CheckpointError
from ..model.gaussians import Gaussians
from ..scene.cameras import Camera
from . import initialization, posing
from .config import Config
from .field import FieldRepresentation
from .groups import GroupTrack, ObservedMotion
from .tracks_representation import TracksRepresentation


class Representation(Protocol):
    """The observed motion of N Gaussians, in training coordinates.

    Attributes:
        name: Its name in the configuration.
    """

    name: str

    @property
    def params(self) -> dict[str, Tensor]:
        """What the optimizer moves, by the names of the learning rates."""
        ...

    def splats(
        self, gaussians: Gaussians, camera: Camera, t: float, draw: torch.Generator | None = None
    ) -> posing.Splats:
        """Activated Gaussians in the world at a time, coloured as a camera sees them; differentiable.

        Args:
            gaussians: The canonical Gaussians.
            camera: The camera, normalised coordinates.
            t: Scene time.
            draw: Source of a training step's draws; None where a picture is wanted.
        """
        ...

    def penalty(self, gaussians: Gaussians, iteration: int) -> Tensor | None:
        """What is added to the loss of the step whose `splats` were asked for last, or None."""
        ...

    def enter(self, knot: int, towards: int, entered: tuple[int, int]) -> None:
        """An observed time joins the training: ``knot`` from its neighbours in direction ``towards`` (+1 or -1)."""
        ...

    def after_step(self, gaussians: Gaussians, iteration: int, draw: torch.Generator) -> None:
        """Upkeep after ``iteration`` steps; ``draw`` is the training's source of draws."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """Everything that must be stored, by name."""
        ...

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from `tensors`."""
        ...

    @staticmethod
    def observed_motion(tensors: dict[str, Tensor], object_ids: np.ndarray, observed: np.ndarray) -> ObservedMotion:
        """Motion groups out of a checkpoint's `tensors`.

        Args:
            tensors: By name, as stored.
            object_ids: Object id of each class, 0 first. [B]
            observed: Knots at which each object was placed by its masks. [B - 1, S] bool
        """
        ...


REPRESENTATIONS: dict[str, type[TracksRepresentation] | type[FieldRepresentation]] = {
    TracksRepresentation.name: TracksRepresentation,
    FieldRepresentation.name: FieldRepresentation,
}


def make(start: initialization.Start, config: Config) -> Representation:
    """The representation that the configuration asks for, at the start of training."""
    return REPRESENTATIONS[config.train.representation](start, config)


def observed_motion(
    name: str, tensors: dict[str, Tensor], object_ids: np.ndarray, observed: np.ndarray
) -> ObservedMotion:
    """Motion groups out of a checkpoint of the representation ``name``.

    Raises:
        CheckpointError: This version has no such representation.
    """
    if name not in REPRESENTATIONS:
        known = ", ".join(REPRESENTATIONS)
        raise CheckpointError(f"the checkpoint was trained with representation '{name}'; this version knows {known}")
    return REPRESENTATIONS[name].observed_motion(tensors, object_ids, observed)


def group_classes(groups: Sequence[GroupTrack], object_ids: np.ndarray) -> np.ndarray:
    """Class that a group's Gaussians have where no mask says otherwise: a body's object, else the background. [G]"""
    row = {int(object_id): k for k, object_id in enumerate(object_ids)}
    return np.array([row[g.object_id] if g.role == "body" else 0 for g in groups], np.int64)
