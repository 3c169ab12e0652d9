"""Base class of motion representations, which move the Gaussians in the observed time.

The trainer uses only the methods of `Representation`. `tracks` moves Gaussians by one SE(3) track per
object, `field` by a deformation field, and `still` not at all. `registry` creates them by name.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ...config.config import Config
from ...errors import CheckpointError
from ...model.gaussians import Gaussians
from ...scene.cameras import Camera
from ..observed_motion import ObservedMotion
from . import fused_posing

if TYPE_CHECKING:
    from ...model.residual_field import ResidualField  # a scene at rest does not load it

TRACKS, FIELD, STILL = "tracks", "field", "still"


class Representation:
    """Observed motion of N Gaussians, in training coordinates. Hooks that a subclass does not need do nothing.

    Attributes:
        name: Name in checkpoints: "tracks", "field" or "still".
        moves: False if nothing ever moves.
        takes_residuals: True if bodies may have `residuals`, which are tried during training.
        sorts_by_motion: True if Gaussians move one by one, so that objects can be found by their motion.
        penalizes_views: True if `penalty` depends on the view of the last call of `splats`.
        residuals: Residual motion of non-rigid bodies, or None.
    """

    name: ClassVar[str]
    moves: ClassVar[bool] = True
    takes_residuals: ClassVar[bool] = False
    sorts_by_motion: ClassVar[bool] = False
    penalizes_views: ClassVar[bool] = False
    residuals: ResidualField | None = None

    def to(self, device: torch.device) -> Representation:
        """Move the state to a device, in place, and return the representation."""
        raise NotImplementedError

    @property
    def params(self) -> dict[str, Tensor]:
        """Parameters for the optimizer; the name before the first dot selects the learning rate."""
        return {}

    def begin(self, gaussians: Gaussians, draw: torch.Generator) -> None:
        """Prepare before the first step."""

    def before_step(self, gaussians: Gaussians, iteration: int, draw: torch.Generator) -> Representation:
        """Return the representation of the step ``iteration``: this one, or another one that continues from it."""
        return self

    def path(self, t: float, draw: torch.Generator) -> Any:
        """Return the argument of `splats` for a training step: a random path to the time, or the time itself."""
        return t

    def graph_state(self) -> tuple[Tensor | None, ...]:
        """Return the tensors that a graph of a step reads, and that are sometimes replaced."""
        return ()

    def graph_kind(self, path: Any, iteration: int) -> tuple | None:
        """Return the kind of a step, which determines its operations besides shapes; None if it cannot be a graph.

        Args:
            path: A result of `path`, with ``numbers`` and ``from_buffer``.
            iteration: The step.
        """
        return None

    def splats(self, gaussians: Gaussians, camera: Camera, t: Any) -> fused_posing.PosedSplats:
        """Return activated Gaussians at a time, with colours as seen by a camera; differentiable.

        Args:
            gaussians: The canonical Gaussians.
            camera: The camera, normalised coordinates.
            t: Scene time, or a result of `path`.

        Returns:
            Splats in training coordinates.
        """
        raise NotImplementedError

    def penalty(self, gaussians: Gaussians, iteration: int, labels: Callable[[], Tensor]) -> Tensor | None:
        """Return a term for the loss of the current step, or of its last view (see `penalizes_views`), or None.

        Args:
            gaussians: The canonical Gaussians.
            iteration: The step.
            labels: Returns the class of each Gaussian. [N]
        """
        return None

    def enter(self, knot: int, towards: int, entered: tuple[int, int]) -> None:
        """Initialise ``knot`` from its neighbours in direction ``towards`` (+1 or -1), as it enters training."""

    def after_step(self, gaussians: Gaussians, iteration: int, draw: torch.Generator) -> None:
        """Maintain the state after ``iteration`` steps; ``draw`` is the random generator of the training."""

    def tensors(self) -> dict[str, Tensor]:
        """Return the complete state, by name."""
        raise NotImplementedError

    def restored(self, name: str, tensors: dict[str, Tensor]) -> Representation:
        """Return the representation ``name`` with a checkpoint's state: this one, or one that `before_step` returns.

        Raises:
            CheckpointError: The checkpoint has another representation than the configuration.
        """
        if name != self.name:
            raise CheckpointError(
                f"the checkpoint was trained with representation '{name}', the configuration has '{self.name}'"
            )
        self.restore(tensors)
        return self

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state from `tensors`."""
        raise NotImplementedError

    @staticmethod
    def group_classes(tensors: dict[str, Tensor]) -> np.ndarray:
        """Return the default class of each group's Gaussians without masks, from a checkpoint's `tensors`. [G]"""
        raise NotImplementedError

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
        raise NotImplementedError
