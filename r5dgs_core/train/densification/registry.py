"""Factory of the densification strategies."""

from __future__ import annotations

import torch

from ...config.config import Config
from . import densifier, gradient, mcmc
from .densifier import Conditions


def make(config: Config, conditions: Conditions, count: int, device: torch.device | str = "cpu") -> densifier.Strategy:
    """Create the strategy that the configuration selects.

    Args:
        config: The run's configuration.
        conditions: Properties of the run.
        count: Initial number of Gaussians.
        device: Device of the Gaussians.
    """
    if config.densify.strategy == "mcmc":
        return mcmc.MCMC(config.densify_mcmc, conditions)
    if config.densify.strategy == "default":
        return gradient.AdaptiveDensityControl(config.densify_default, conditions, count, device)
    return gradient.TopGradientShare(config.densify, conditions, count, device)
