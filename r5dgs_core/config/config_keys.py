"""Keys of the configuration with description, unit, default and value, as listed by ``r5dgs config``."""

from __future__ import annotations

import dataclasses
import functools
import re
from dataclasses import dataclass
from typing import Any

from .config import Config

_KEYS_BY_UNIT = {
    "steps": """
        train.iterations train.sh_every train.checkpoint_every train.log_every train.probe_every field.warm_up
        field.place_steps field.distill_steps field.trd_steps curriculum.first curriculum.grow densify.start
        densify.every densify_default.start densify_default.every densify_default.reset_every densify_mcmc.start
        densify_mcmc.every discovery.iterations residual.trial_steps identity.iterations identity.every
        identity.regularise_every
    """,
    "share of the run": """
        rates.decay_from losses.rigid_start field.gate field.tracks_share field.trd_every densify.stop
        densify_default.stop densify_mcmc.stop discovery.gate residual.start
    """,
    "share": """
        losses.ssim field.trd_share curriculum.newest densify.share densify_mcmc.grow
    """,
    "share of the image": "init.min_mask_pixels init.unexplained",
    "share of the images": "data.min_registered",
    "GB": "data.memory",
    "share of the image width": "densify.prune_width",
    "share of the cameras' extent": "densify_default.percent_dense densify_default.prune_extent",
    "opacity, 0 to 1": """
        init.opacity densify.prune_opacity densify_default.prune_opacity densify_default.reset_opacity
        densify_mcmc.dead_opacity
    """,
    "learning rate": """
        rates.means rates.log_scales rates.sh rates.sh_rest rates.opacity_logits rates.quats rates.shading rates.light
        rates.translations rates.rotvecs rates.slope rates.field rates.trd rates.residual rates.background
        identity.rate identity.classifier_rate
    """,
    "factor": "init.shading rates.decay rates.decay_networks rates.decay_floor_appearance densify_mcmc.noise",
    "weight": """
        losses.roughness losses.rigid field.calm field.twist field.stiffness densify.opacity densify_mcmc.opacity
        densify_mcmc.scale residual.size residual.roughness identity.weight identity.spatial identity.majority
    """,
    "normalised length": "field.still discovery.still densify.prune_near",
    "scene time": "field.horizon field.step",
    "1 / half image width": "densify.gradient densify_default.gradient",
    "px": "densify.split_pixels densify_default.prune_radius refine.pixels",
    "intervals": "refine.intervals",
    "share of white": "refine.colors",
    "dB": "residual.threshold",
    "Gaussians": """
        init.object_points init.background_points init.shadow_points field.chunk densify.max_gaussians
        discovery.fewest identity.neighbours identity.samples
    """,
    "count": """
        field.width train.batch train.threads train.probe_views init.sweep_depths curriculum.stages residual.nodes
    """,
    "degree": "train.sh_degree",
    "integer": "train.seed",
}
_UNITS = {key: unit for unit, keys in _KEYS_BY_UNIT.items() for key in keys.split()}
_MEANING = re.compile(r"^        (\w+): (.*(?:\n {12}.*)*)", re.MULTILINE)  # an entry under "Attributes:"


@dataclass(frozen=True)
class Key:
    """Key of the configuration.

    Attributes:
        name: ``section.key``.
        meaning: Description, taken from the section's docstring.
        unit: Unit of a number, "text" or "true or false".
        default: Default value.
        value: Current value.
    """

    name: str
    meaning: str
    unit: str
    default: Any
    value: Any


def keys(config: Config) -> list[Key]:
    """Return all keys of a configuration, in the order of the sections."""
    defaults = Config()
    found = []
    for section in dataclasses.fields(Config):
        usual, given = getattr(defaults, section.name), getattr(config, section.name)
        meanings = _meanings(type(given))
        for field in dataclasses.fields(given):
            name, default = f"{section.name}.{field.name}", getattr(usual, field.name)
            unit = "true or false" if isinstance(default, bool) else "text" if isinstance(default, str) else None
            value = getattr(given, field.name)
            found.append(Key(name, meanings[field.name], unit or _UNITS[name], default, value))
    return found


@functools.cache
def _meanings(section: type) -> dict[str, str]:
    """Parse the descriptions of a section's keys from its docstring."""
    found = _MEANING.findall(section.__doc__ or "")
    return {key: " ".join(text.replace("``", "'").split()) for key, text in found}
