"""Steps that draw several views and update the parameters by the mean of their gradients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..raster import RasterStats
from ..scene.cameras import Camera
from . import devices, running_loss
from .step_graphs import StepInputs


@dataclass(frozen=True)
class Drawn:
    """Result of one view of a step, besides its gradients.

    Attributes:
        index: Index of the view.
        camera: Its camera, as it was drawn.
        loss: Its loss, a scalar without gradient.
        stats: Statistics for densification.
        correction: Gradients by the correction of its camera (`Refinement.measure`), or None.
    """

    index: int
    camera: Camera
    loss: Tensor
    stats: RasterStats
    correction: np.ndarray | None


def update(trainer: Any, batch: Sequence[StepInputs], place: str) -> Tensor:
    """Draw views, update all parameters by the mean of the gradients, and return the mean loss.

    Penalties that no view determines are counted once. Corrections of cameras and statistics for densification are
    updated once for each view, in the order of the batch.

    Args:
        trainer: The `trainer.Trainer`, which imports this module.
        batch: Inputs of the views.
        place: Step and views, for messages.
    """
    trainer.optimizer.zero_grad(set_to_none=True)
    drawn = [_draw(trainer, inputs, place) for inputs in batch]
    parameters = [p for group in trainer.optimizer.param_groups for p in group["params"]]
    for parameter in parameters:
        if parameter.grad is not None:
            parameter.grad /= len(batch)
    penalties = [term for term in trainer.penalties() if term is not None]
    if penalties:
        torch.stack(penalties).sum().backward()
    loss = torch.stack([one.loss for one in drawn]).mean()
    if trainer.device.type == devices.CPU:
        running_loss.require_finite_step(loss, trainer.optimizer, trainer.params, place)
    for one in drawn:
        trainer.refinement.apply(one.index, one.camera.width, one.correction, trainer.iteration)
    trainer.move()
    for one in drawn:
        trainer.densifier.observe(one.stats, one.camera)
    return loss


def _draw(trainer: Any, inputs: StepInputs, place: str) -> Drawn:
    """Draw a view and add its gradients to those of the parameters."""
    stats, view = RasterStats(), inputs.view
    loss, identity, splats = trainer.compare(inputs, stats, place)
    (loss if identity is None else loss + identity).backward()
    correction = trainer.refinement.measure(inputs.index, view, splats, lambda t: trainer.splats(view.camera, t))
    return Drawn(inputs.index, view.camera, loss.detach(), stats, correction)
