"""Effects of the user's ``needs.*`` overrides on training."""

from __future__ import annotations

from typing import Any

from ..data.dataset import Dataset
from .config import Config


def resolve(config: Config) -> Config:
    """Apply the user's ``needs.*`` overrides to the training configuration.

    Args:
        config: Configuration as given by the user; the result keeps its ``needs``.
    """
    wanted = config.needs
    changes: dict[str, Any] = {}
    if wanted.shading == "off":
        changes["train.shading"] = False
    if wanted.shadows == "off":
        changes["train.shadows"] = False
    if wanted.classifier == "off":
        changes["identity.iterations"] = 0
    if wanted.view_dependent_colour != "auto":
        on = wanted.view_dependent_colour == "on"
        changes["train.sh_degree"] = max(1, config.train.sh_degree) if on else 0
    if wanted.tracks == "off":
        changes |= {"rates.translations": 0.0, "rates.rotvecs": 0.0}
    if wanted.rotation == "off":
        changes["rates.rotvecs"] = 0.0
    return config.replace(**changes)


def discovery(dataset: Dataset, config: Config) -> bool:
    """True if a run must discover its moving objects: it starts with tracks and has several times and no masks."""
    tracks = config.train.representation == "tracks" or config.field.tracks_share > 0
    return tracks and _looks_for_parts(dataset, config)


def sorting(dataset: Dataset, config: Config) -> bool:
    """True if a finished run must sort its Gaussians into rigid parts: a field with several times and no masks."""
    field = config.train.representation == "field" and config.field.tracks_share == 0
    return field and _looks_for_parts(dataset, config)


def _looks_for_parts(dataset: Dataset, config: Config) -> bool:
    """True if objects must be found by their motion: there are several times but no masks."""
    unmasked = all(view.mask_path is None for view in dataset.train)
    several = len({view.t for view in dataset.train}) > 1
    return unmasked and several and config.discovery.iterations > 0 and config.needs.tracks != "off"
