"""How Gaussians move in the observed time: the border that every representation keeps.

The trainer knows only `Representation`: splats at a time, what to optimise, a penalty, upkeep, and named tensors for
the checkpoint. `tracks` moves Gaussians by one SE(3) track per object, `field` by a deformation field, `still` not at
all. `registry` makes them by name.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from ...config.config import Config
from ...model.gaussians import Gaussians
from ...scene.cameras import Camera
from ..observed_motion import ObservedMotion
from . import fused_posing

TRACKS, FIELD, STILL = "tracks", "field", "still"


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
    ) -> fused_posing.Splats:
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
