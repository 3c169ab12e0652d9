"""Steps that draw several views and update the parameters by the mean of their gradients."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import TrainingError
from ..raster import RasterStats
from ..scene.cameras import Camera
from . import devices, losses, running_loss
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

    def to(self, device: torch.device | str) -> Drawn:
        """Return the result with its tensors on a device."""
        found = RasterStats()
        found.visible, found.radii, found.grad_norm = (
            torch.as_tensor(values).to(device)
            for values in (self.stats.visible, self.stats.radii, self.stats.grad_norm)
        )
        return dataclasses.replace(self, loss=self.loss.to(device), stats=found)


def update(trainer: Any, batch: Sequence[StepInputs], place: str) -> Tensor:
    """Draw views, update all parameters by the mean of the gradients, and return the mean loss.

    Penalties that no view determines are counted once. Corrections of cameras and statistics for densification are
    updated once for each view, in the order of the batch.

    Args:
        trainer: The `trainer.Trainer`, which imports this module.
        batch: Inputs of the views that this process draws.
        place: Step and views, for messages.
    """
    trainer.optimizer.zero_grad(set_to_none=True)
    drawn = _of_all(trainer, [_draw(trainer, inputs, place) for inputs in batch], place)
    parameters = [p for group in trainer.optimizer.param_groups for p in group["params"]]
    trainer.workers.add_gradients(parameters)
    for parameter in parameters:
        if parameter.grad is not None:
            parameter.grad /= len(drawn)
    _add_penalties(trainer, parameters)
    loss = torch.stack([one.loss for one in drawn]).mean()
    if trainer.device.type == devices.CPU:
        running_loss.require_finite_step(loss, trainer.optimizer, trainer.params, place)
    for one in drawn:
        trainer.refinement.apply(one.index, one.camera.width, one.correction, trainer.iteration)
    trainer.move()
    for one in drawn:
        trainer.densifier.observe(one.stats, one.camera)
    return loss


def _add_penalties(trainer: Any, parameters: Sequence[Tensor]) -> None:
    """Add the gradients of the penalties, which the leading process computes for all processes.

    A GPU rounds their sums differently each time, so the parameters of the processes would drift apart.
    """
    gradients: Sequence[Tensor | None] = [None] * len(parameters)
    if trainer.workers.leads:
        penalties = [term for term in trainer.penalties() if term is not None and term.requires_grad]
        if penalties:
            gradients = torch.autograd.grad(torch.stack(penalties).sum(), parameters, allow_unused=True)
    for parameter, gradient in zip(parameters, trainer.workers.of_leader(parameters, gradients), strict=True):
        if gradient is not None:
            parameter.grad = gradient.clone() if parameter.grad is None else parameter.grad.add_(gradient)


def _of_all(trainer: Any, drawn: Sequence[Drawn], place: str) -> list[Drawn]:
    """Return the results of the processes of the run in the order of the views, on the device of this process.

    Raises:
        TrainingError: The processes have different Gaussians.
    """
    if trainer.workers.count == 1:
        return list(drawn)
    means = trainer.gaussians.means.detach()
    state = len(means), repr(float(means.sum(dtype=torch.float64)))  # as text, nan equals nan
    found = trainer.workers.gather([(state, one.to("cpu")) for one in drawn])
    if len({state for state, _ in found}) > 1:
        raise TrainingError(
            f"{place}: the processes of this run have different Gaussians; the last checkpoint is kept. Remedy: give "
            "all processes the same files, packages and type of processor or GPU, and repeat the command with --resume"
        )
    return [one.to(trainer.device) for _, one in found]


def _draw(trainer: Any, inputs: StepInputs, place: str) -> Drawn:
    """Draw a view and add its gradients to those of the parameters."""
    stats, view = RasterStats(), inputs.view
    loss, identity, splats = trainer.compare(inputs, stats, place)
    losses.total(loss, trainer.view_penalty(), identity).backward()
    correction = trainer.refinement.measure(inputs.index, view, splats, lambda t: trainer.splats(view.camera, t))
    return Drawn(inputs.index, view.camera, loss.detach(), stats, correction)
