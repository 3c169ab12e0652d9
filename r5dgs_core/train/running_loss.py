"""Smoothed loss of a run, and the check that it and the parameters stay finite.

On the CPU loss and gradients of every step are checked. On a GPU the check would make the processor wait for each step;
the loss and the parameters, which a gradient that is not finite spoils, are checked every `CHECK_EVERY` steps.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from . import optimizer as optimizers

CHECK_EVERY = 50  # steps between checks on a GPU
OLD, NEW = 0.98, 0.02  # weights of the mean so far and of a step


class RunningLoss:
    """Exponential mean of the losses of the steps, nan before the first one."""

    def __init__(self, value: float = math.nan):
        self._value: float | Tensor = value

    @property
    def value(self) -> float:
        """The mean; reading it waits for the device."""
        return float(self._value)

    def add(self, loss: Tensor) -> None:
        """Add the loss of a step, a scalar without gradient."""
        new = float(loss) if loss.device.type == "cpu" else loss.double()
        first = isinstance(self._value, float) and math.isnan(self._value)
        self._value = new if first else OLD * self._value + NEW * new


def require_finite_step(loss: Tensor, optimizer: torch.optim.Adam, named: dict[str, Tensor], place: str) -> None:
    """Raise `TrainingError` if the loss or a gradient is not finite.

    Args:
        loss: The loss of the step, a scalar without gradient.
        optimizer: The optimizer, with gradients.
        named: Parameters by name, for the message.
        place: Step and view, for the message.
    """
    value = float(loss)
    if not (math.isfinite(value) and optimizers.has_finite_gradients(optimizer)):
        optimizers.check_finite(named, value, place)


def require_finite_state(loss: Tensor, named: dict[str, Tensor], place: str) -> None:
    """Raise `TrainingError` if the loss or a parameter is not finite; arguments as for `require_finite_step`."""
    sums = [loss, *(parameter.detach().sum() for parameter in named.values())]
    if not math.isfinite(float(torch.stack(sums).sum())):
        optimizers.check_finite(named, float(loss), place)
