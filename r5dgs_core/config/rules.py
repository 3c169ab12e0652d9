"""Checks of configuration values: type and range of each key, and contradictions between keys."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, get_type_hints

from .. import findings
from ..errors import ConfigError
from .sections.densification import STRATEGIES
from .sections.identity import IDENTITY_TRAINING, INCLUDE_SELF
from .sections.motion import FIELD_SIZES, MOVERS, VARIANTS
from .sections.needs import NEEDS, NeedsSection
from .sections.training import BACKGROUNDS, CURRICULA, DEVICES, PLACEMENTS, REPRESENTATIONS, RIGID_FORMS


def _check_writable(name: str, value: object) -> None:
    """Raise `ConfigError` for integers and text that ``run.json`` cannot store."""
    if isinstance(value, int) and abs(value) >= 1 << 63:
        raise ConfigError(f"{name}: expected a number of at most 64 bits, got a longer one")
    try:
        if isinstance(value, str):
            value.encode()
    except UnicodeEncodeError:
        raise ConfigError(f"{name}: expected text in UTF-8, got {value!a:.60}") from None


def check_key(name: str, value: Any, kind: type) -> Any:
    """Return the value of a key, with integers converted if a float is expected. Raises `ConfigError` if invalid."""
    _check_writable(name, value)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ConfigError(f"{name}: expected {kind.__name__}, got {value!r:.200}")
    if kind in (int, float) and not 0 <= value < math.inf:
        raise ConfigError(f"{name}: expected a finite number that is not negative, got {value!r}")
    good, expected = RULES.get(name, (None, ""))
    if good is not None and not good(value):
        raise ConfigError(f"{name}: expected {expected}, got {value!r}")
    return value


def check_contradictions(config: Any, guard: findings.Guard) -> None:
    """Raise `ConfigError` if the values of two keys of a `config.Config` contradict each other."""
    with guard():
        if config.train.representation == "field" and config.needs.rotation == "off":
            raise ConfigError("needs.rotation: only tracks can be trained without rotation; leave it out for a field")
    with guard():
        everything = config.train.representation == "field" and config.field.movers in ("all", "measured")
        if config.init.placement == "random" and (not everything or config.field.tracks_share > 0):
            raise ConfigError(
                "init.placement: random places nothing on objects, so it needs train.representation='field', "
                "field.movers='all' or 'measured', and field.tracks_share=0"
            )
    for need, name in _CONTRADICTED.items():
        with guard():
            found = _value(config, name)
            if getattr(config.needs, need) == "on" and not found:
                raise ConfigError(f"needs.{need} is on, but {name} is {found!r}; leave one of them out")
    for need, name, value in _EXCLUDED:
        with guard():
            if getattr(config.needs, need) == "on" and _value(config, name) == value:
                raise ConfigError(f"needs.{need} is on, but {name} is {value!r}; leave one of them out")


def _value(config: Any, name: str) -> Any:
    section, key = name.split(".")
    return getattr(getattr(config, section), key)


# Keys that must be non-zero if the need is "on".
_CONTRADICTED = {"shading": "train.shading", "shadows": "train.shadows", "classifier": "identity.iterations"}
# Settings that exclude a need: (need, key, value).
_EXCLUDED = (
    ("classifier", "identity.training", "off"),
    ("residuals", "train.representation", "field"),
    ("residuals", "needs.tracks", "off"),
    ("residuals", "residual.start", 1.0),
)
_AT_LEAST_1: tuple[Callable[[Any], bool], str] = (lambda value: value >= 1, "at least 1")
_SHARE: tuple[Callable[[Any], bool], str] = (lambda value: 0 <= value <= 1, "0 to 1")
_POSITIVE: tuple[Callable[[Any], bool], str] = (lambda value: value > 0, "more than 0")
_INSIDE: tuple[Callable[[Any], bool], str] = (lambda value: 0 < value < 1, "between 0 and 1")
# Constraints beyond the type; `check_key` ensures that all numbers are finite and not negative.
RULES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "data.min_registered": _SHARE,
    "data.memory": _POSITIVE,
    "train.iterations": _AT_LEAST_1,
    "train.batch": _AT_LEAST_1,
    "train.seed": (lambda value: value < 2**63 - 1, "less than 2^63 - 1"),
    "train.device": (lambda value: re.fullmatch(DEVICES, value) is not None, "auto, cpu, cuda or cuda:N"),
    "train.representation": (lambda value: value in REPRESENTATIONS, " or ".join(REPRESENTATIONS)),
    "field.variant": (lambda value: value in VARIANTS, " or ".join(VARIANTS)),
    "field.size": (lambda value: value in FIELD_SIZES, " or ".join(FIELD_SIZES)),
    "field.width": (lambda value: value <= 4096, "at most 4096"),
    "field.movers": (lambda value: value in MOVERS, " or ".join(MOVERS)),
    "field.gate": _SHARE,
    "field.trd_share": _SHARE,
    "field.trd_every": _SHARE,
    "field.tracks_share": (
        lambda value: 0 <= value < 1,
        "0 to less than 1, as the rest of the run trains the field",
    ),
    "field.chunk": _AT_LEAST_1,
    "losses.rigid_form": (lambda value: value in RIGID_FORMS, " or ".join(RIGID_FORMS)),
    "losses.rigid_start": _SHARE,
    "identity.training": (lambda value: value in IDENTITY_TRAINING, " or ".join(IDENTITY_TRAINING)),
    "identity.every": _AT_LEAST_1,
    "identity.regularise_every": _AT_LEAST_1,
    "identity.neighbours": _AT_LEAST_1,
    "identity.include_self": (lambda value: value in INCLUDE_SELF, " or ".join(INCLUDE_SELF)),
    "identity.samples": _AT_LEAST_1,
    "rates.decay_networks": (lambda value: 0 < value <= 1, "more than 0, at most 1"),
    "train.background": (lambda value: value in BACKGROUNDS, " or ".join(BACKGROUNDS)),
    "train.sh_degree": (lambda value: value <= 3, "0 to 3"),
    "train.threads": _AT_LEAST_1,
    "train.checkpoint_every": _AT_LEAST_1,
    "train.log_every": _AT_LEAST_1,
    "train.probe_views": _AT_LEAST_1,
    "init.object_points": _AT_LEAST_1,
    "init.background_points": _AT_LEAST_1,
    "init.sweep_depths": (lambda value: value >= 2, "at least 2"),
    "init.opacity": _INSIDE,
    "init.min_mask_pixels": (lambda value: value < 1, "less than 1"),
    "init.unexplained": _SHARE,
    "rates.decay": (lambda value: 0 < value <= 1, "more than 0, at most 1"),
    "rates.decay_floor_appearance": _SHARE,
    "rates.decay_from": _SHARE,
    "losses.ssim": _SHARE,
    "curriculum.start": (lambda value: value in CURRICULA, " or ".join(CURRICULA)),
    "curriculum.newest": _SHARE,
    "init.placement": (lambda value: value in PLACEMENTS, " or ".join(PLACEMENTS)),
    "densify.strategy": (lambda value: value in STRATEGIES, " or ".join(STRATEGIES)),
    "discovery.gate": _SHARE,
    "discovery.fewest": _AT_LEAST_1,
    "residual.start": _SHARE,
    "residual.trial_steps": _AT_LEAST_1,
    "residual.nodes": _AT_LEAST_1,
    "densify.stop": _SHARE,
    "densify.every": _AT_LEAST_1,
    "densify.share": _SHARE,
    "densify.prune_opacity": (lambda value: value < 1, "less than 1"),
    "densify.prune_width": _POSITIVE,
    "densify_default.stop": _SHARE,
    "densify_default.every": _AT_LEAST_1,
    "densify_default.prune_opacity": (lambda value: value < 1, "less than 1"),
    "densify_default.prune_radius": _POSITIVE,
    "densify_default.prune_extent": _POSITIVE,
    "densify_default.reset_opacity": _INSIDE,
    "densify_mcmc.stop": _SHARE,
    "densify_mcmc.every": _AT_LEAST_1,
    "densify_mcmc.dead_opacity": _INSIDE,
    **{f"needs.{key}": (lambda value: value in NEEDS, " or ".join(NEEDS)) for key in get_type_hints(NeedsSection)},
}
