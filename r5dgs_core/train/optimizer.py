"""Adam of a run: one group per named parameter, its learning rate at each step, and its state in checkpoints."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from ..config.config import Config
from ..errors import CheckpointError, TrainingError
from .representations.representation import TRACKS

GEOMETRY = ("means", "translations", "rotvecs", "light", "slope", "residual")
NETWORKS = ("field", "trd")
APPEARANCE = ("log_scales", "sh", "sh_rest", "opacity_logits", "background")


class LearningRates:
    """Learning rates by the part of a parameter's name before the first dot.

    Args:
        config: The run's configuration.
        constant: Rates of further parameters, which do not decay.
    """

    def __init__(self, config: Config, constant: Mapping[str, float]):
        self._config = config
        self._constant = constant
        alone, entered = config.curriculum.steps(config.train.iterations)
        tracks = config.train.representation == TRACKS
        # The images of one time do not show the light, and those of a few times explain turns as shading.
        self._begins = {"light": alone, "shading": entered} if tracks else {}

    def initial(self, name: str) -> float:
        """Return the rate at the first step."""
        group = name.partition(".")[0]
        return self._constant[group] if group in self._constant else getattr(self._config.rates, group)

    def at(self, name: str, iteration: int) -> float:
        """Return the rate at a step."""
        rates, base = self._config.rates, self.initial(name)
        name = name.partition(".")[0]
        if name == "shading" and not self._config.train.shading:
            return 0.0
        if iteration < self._begins.get(name, 0):
            return 0.0
        progress = iteration / self._config.train.iterations
        begin = self._config.residual.start if name == "residual" else rates.decay_from  # residuals start late
        if progress <= begin or name not in GEOMETRY + APPEARANCE + NETWORKS:
            return base
        decay = rates.decay_networks if name in NETWORKS else rates.decay
        factor = decay ** ((progress - begin) / (1 - begin))
        return base * (max(factor, rates.decay_floor_appearance) if name in APPEARANCE else factor)


def make(gaussians: Mapping[str, Tensor], others: Mapping[str, Tensor], rates: LearningRates) -> torch.optim.Adam:
    """Return the optimizer of the Gaussians' parameters, and of all others that require a gradient."""
    groups = [(name, p, 1e-15) for name, p in gaussians.items()]
    groups += [(name, p, 1e-8) for name, p in others.items() if p.requires_grad]
    return torch.optim.Adam(
        [{"params": [p], "lr": rates.initial(name), "name": name, "eps": eps} for name, p, eps in groups], fused=True
    )


def tensors(optimizer: torch.optim.Adam) -> dict[str, Tensor]:
    """Return the moments by ``adam.NAME.MOMENT``."""
    return {
        f"adam.{group['name']}.{moment}": value
        for group in optimizer.param_groups
        for moment, value in optimizer.state.get(group["params"][0], {}).items()
    }


def restore(optimizer: torch.optim.Adam, named: Mapping[str, Tensor]) -> None:
    """Restore the moments from `tensors`. Raises CheckpointError if a shape does not match."""
    for group in optimizer.param_groups:
        prefix, parameter = f"adam.{group['name']}.", group["params"][0]
        moments = {n.removeprefix(prefix): t for n, t in named.items() if n.startswith(prefix)}
        if any(tensor.ndim and tensor.shape != parameter.shape for tensor in moments.values()):
            expected = list(parameter.shape)
            raise CheckpointError(f"the checkpoint's '{prefix}*': expected tensors of shape {expected}")
        if moments:
            optimizer.state[parameter] = moments


def has_finite_gradients(optimizer: torch.optim.Adam) -> bool:
    """Return True if all gradients are finite. Sums are cheap, and not finite if any term is not."""
    sums = [p.grad.sum() for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
    return math.isfinite(float(torch.stack(sums).sum()))


def check_finite(named: Mapping[str, Tensor], loss: float, place: str) -> None:
    """Raise `TrainingError` if the loss, a parameter or a gradient is not finite.

    Args:
        named: Parameters by name.
        loss: The loss.
        place: Step and view, for the message.
    """
    bad = [n for n, p in named.items() if not bool(torch.isfinite(p).all())]
    bad += [f"gradient of {n}" for n, p in named.items() if p.grad is not None and not p.grad.isfinite().all()]
    if bad or not math.isfinite(loss):
        sizes = {n: float(p.detach().abs().nan_to_num(0, 0).max()) for n, p in named.items() if p.numel() > 0}
        largest = max(sizes, key=sizes.__getitem__)
        more = f" and {len(bad) - 4} more" if len(bad) > 4 else ""
        raise TrainingError(
            f"{place}: not finite: {', '.join(bad[:4]) or 'loss'}{more} (largest finite value: "
            f"{sizes[largest]:.3g}, of {largest}); the last checkpoint is kept. "
            "Remedy: lower the learning rates (--set rates.means=5e-4) or look at that image and its camera"
        )
