"""Training settings of the benchmark's variants, and of the presets they are combined with. Does not import torch."""

from __future__ import annotations

import json
from typing import Any

from ..config import config as configs
from ..config.presets import PRESETS

# The method trains identities jointly with the geometry (docs/results/training.md). Scaling all identity losses by 1/20
# protects the geometry; the encodings learn at the same rate, because their optimizer is invariant to the scale.
_IDENTITIES = {"identity.training": "joint", "identity.weight": "0.05", "identity.spatial": "0.1"}
_FIELD = {"train.representation": "field", **_IDENTITIES}
# Training from tracks needs the objects placed in the scene.
_PLACED = {"init.placement": "scene"}
# Settings of each variant; they override everything that the user gives.
VARIANTS: dict[str, dict[str, str]] = {
    "5dgs": {**_FIELD, "field.variant": "5dgs"},
    "r5dgs": {**_FIELD, "field.variant": "r5dgs"},
    "r5dgs_extra": {**_FIELD, "field.variant": "r5dgs_extra", "identity.majority": "0.025"},
    "from_tracks": {
        "train.representation": "field",
        "field.variant": "r5dgs",
        "field.tracks_share": "0.4",
        "field.movers": "labelled",
        **_PLACED,
    },
    "tracks": {"train.representation": "tracks", **_PLACED},
}
# Settings of a variant that ``--set`` overrides.
DEFAULTS = {"r5dgs_extra": {"losses.rigid_form": "squared"}}
# `5dgs` is trained like `r5dgs` and differs only in playback, so its row comes from the checkpoint of `r5dgs`.
DEFAULT_VARIANTS = ("r5dgs", "r5dgs_extra", "from_tracks", "tracks")
# Keys that variants leave to a preset: `paper` has the paper's weights.
KEPT = {"paper": ("identity.weight", "identity.spatial", "identity.majority")}
# Sections and keys of field presets that do not suit tracks, which keep their defaults.
UNSUITED = {
    "from_tracks": ("init", "curriculum", "train.shading", "train.shadows"),
    "tracks": ("init", "curriculum", "train.shading", "train.shadows", "rates", "densify.strategy", "identity"),
}


def settings(variant: str, preset: str | None) -> dict[str, str]:
    """Return the settings that a variant enforces, by ``section.key`` as for ``--set``."""
    return {key: value for key, value in VARIANTS[variant].items() if key not in KEPT.get(preset or "", ())}


def suited(variant: str, preset: str | None) -> dict[str, str]:
    """Return defaults of a variant, and of preset keys that suit the field but not a variant with tracks.

    ``--set`` overrides them.
    """
    given: dict[str, Any] = PRESETS.get(preset or "", {})
    found = dict(DEFAULTS.get(variant, {}))
    if given.get("train.representation") != "field":
        return found
    defaults = configs.Config().to_dict()
    for name in given:
        section, _, key = name.partition(".")
        if {name, section} & set(UNSUITED.get(variant, ())):
            found[name] = json.dumps(defaults[section][key])
    return found
