"""Interface of motion representations, which move the Gaussians in the observed time.

The trainer uses only `Representation`: splats at a time, parameters, a penalty, maintenance after each step, and named
tensors for the checkpoint. `tracks` moves Gaussians by one SE(3) track per object, `field` by a deformation field, and
`still` not at all. `registry` creates them by name.
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
    """Observed motion of N Gaussians, in training coordinates.

    Attributes:
        name: Name in checkpoints: "tracks", "field" or "still".
    """

    name: str

    @property
    def params(self) -> dict[str, Tensor]:
        """Parameters for the optimizer; the name before the first dot selects the learning rate."""
        ...

    def begin(self, gaussians: Gaussians, draw: torch.Generator) -> None:
        """Prepare before the first step."""
        ...

    def splats(
        self, gaussians: Gaussians, camera: Camera, t: float, draw: torch.Generator | None = None
    ) -> fused_posing.Splats:
        """Return activated Gaussians at a time, with colours as seen by a camera; differentiable.

        Args:
            gaussians: The canonical Gaussians.
            camera: The camera, normalised coordinates.
            t: Scene time.
            draw: Random generator of a training step; None to render an image.

        Returns:
            Splats in training coordinates.
        """
        ...

    def penalty(self, gaussians: Gaussians, iteration: int, labels: Callable[[], Tensor]) -> Tensor | None:
        """Return a term for the loss of the current step (the last call of `splats`), or None.

        Args:
            gaussians: The canonical Gaussians.
            iteration: The step.
            labels: Returns the class of each Gaussian. [N]
        """
        ...

    def enter(self, knot: int, towards: int, entered: tuple[int, int]) -> None:
        """Initialise ``knot`` from its neighbours in direction ``towards`` (+1 or -1), as it enters training."""
        ...

    def after_step(self, gaussians: Gaussians, iteration: int, draw: torch.Generator) -> None:
        """Maintain the state after ``iteration`` steps; ``draw`` is the random generator of the training."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """Return the complete state, by name."""
        ...

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state from `tensors`."""
        ...

    @staticmethod
    def group_classes(tensors: dict[str, Tensor]) -> np.ndarray:
        """Return the default class of each group's Gaussians without masks, from a checkpoint's `tensors`. [G]"""
        ...

    @staticmethod
    def observed_motion(
        tensors: dict[str, Tensor], object_ids: np.ndarray, observed: np.ndarray, labels: np.ndarray, config: Config
    ) -> ObservedMotion:
        """Return the motion groups from a checkpoint's `tensors`.

        Args:
            tensors: Stored tensors by name, including those of the Gaussians.
            object_ids: Object id of each class, 0 first. [B]
            observed: Knots at which each object was located by its masks. [B - 1, S] bool
            labels: Class of each Gaussian. [N]
            config: The run's configuration.
        """
        ...
