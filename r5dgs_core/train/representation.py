"""How Gaussians move in the observed time: the border that every representation keeps.

The trainer knows only `Representation`: splats at a time, what to optimise, a penalty, upkeep, and named tensors for
the checkpoint. `tracks` moves Gaussians by one SE(3) track per object; a deformation field is another class with the
same face.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from ..errors import CheckpointError
from ..model.gaussians import Gaussians
from ..scene.cameras import Camera
from . import initialization, posing
from .config import Config
from .field import FieldRepresentation, bring_together
from .groups import ObservedMotion
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

    def begin(self, gaussians: Gaussians, draw: torch.Generator) -> None:
        """What is done once, before the first step."""
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

    def penalty(self, gaussians: Gaussians, iteration: int, labels: Callable[[], Tensor]) -> Tensor | None:
        """What is added to the loss of the step whose `splats` were asked for last, or None.

        Args:
            gaussians: The canonical Gaussians.
            iteration: The step.
            labels: Gives the class of each Gaussian. [N]
        """
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
    def group_classes(tensors: dict[str, Tensor]) -> np.ndarray:
        """Class that a group's Gaussians have where no mask says otherwise, out of a checkpoint's `tensors`. [G]"""
        ...

    @staticmethod
    def observed_motion(
        tensors: dict[str, Tensor], object_ids: np.ndarray, observed: np.ndarray, labels: np.ndarray, config: Config
    ) -> ObservedMotion:
        """Motion groups out of a checkpoint's `tensors`.

        Args:
            tensors: By name, as stored, those of the Gaussians too.
            object_ids: Object id of each class, 0 first. [B]
            observed: Knots at which each object was placed by its masks. [B - 1, S] bool
            labels: Class of each Gaussian. [N]
            config: The run's configuration.
        """
        ...


REPRESENTATIONS: dict[str, type[TracksRepresentation] | type[FieldRepresentation]] = {
    TracksRepresentation.name: TracksRepresentation,
    FieldRepresentation.name: FieldRepresentation,
}


def make(start: initialization.Start, config: Config) -> Representation:
    """The representation that training starts with: the one asked for, or the tracks that a field starts from."""
    if config.train.representation == TracksRepresentation.name or config.field.tracks_share > 0:
        return TracksRepresentation(start, config)
    bring_together(start.gaussians, start.tracks, start.first_time)
    return FieldRepresentation(start.tracks, start.first_time, config)


def observed_motion(
    name: str,
    tensors: dict[str, Tensor],
    object_ids: np.ndarray,
    observed: np.ndarray,
    labels: np.ndarray,
    config: Config,
) -> ObservedMotion:
    """`Representation.observed_motion` of the representation ``name``.

    Raises:
        CheckpointError: This version has no such representation.
    """
    return _known(name).observed_motion(tensors, object_ids, observed, labels, config)


def group_classes(name: str, tensors: dict[str, Tensor]) -> np.ndarray:
    """`Representation.group_classes` of the representation ``name``. [G]

    Raises:
        CheckpointError: This version has no such representation.
    """
    return _known(name).group_classes(tensors)


def _known(name: str) -> type[TracksRepresentation] | type[FieldRepresentation]:
    if name not in REPRESENTATIONS:
        known = ", ".join(REPRESENTATIONS)
        raise CheckpointError(f"the checkpoint was trained with representation '{name}'; this version knows {known}")
    return REPRESENTATIONS[name]
