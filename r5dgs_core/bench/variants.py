"""What a benchmark trains: the settings of each variant, and what it leaves of a preset. Needs no torch."""

from __future__ import annotations

import json
from typing import Any

from ..config import config as configs
from ..config.presets import PRESETS

# The method has its identities trained with the geometry (docs/user/field.md). All their losses at a twentieth: the
# encodings, whose optimizer does not feel the scale, learn as at the paper's weights, and the geometry is not harmed.
_IDENTITIES = {"identity.training": "joint", "identity.weight": "0.05", "identity.spatial": "0.1"}
_FIELD = {"train.representation": "field", **_IDENTITIES}
# Whoever starts from tracks needs objects in their places.
_PLACED = {"init.placement": "scene"}
# What each variant sets; it wins over everything that the user gives.
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
# `5dgs` is trained as `r5dgs` is and differs only in how it is played, so its row comes from the checkpoint of `r5dgs`.
DEFAULT_VARIANTS = ("r5dgs", "r5dgs_extra", "from_tracks", "tracks")
# Preset `paper` has the paper's weights, which its variants keep.
KEPT = {"paper": ("identity.weight", "identity.spatial", "identity.majority")}
# What a preset for the field says of these (sections or keys) does not suit tracks; they keep their defaults.
UNSUITED = {
    "from_tracks": ("init", "curriculum", "train.shading", "train.shadows"),
    "tracks": ("init", "curriculum", "train.shading", "train.shadows", "rates", "densify.strategy", "identity"),
}


def settings(variant: str, preset: str | None) -> dict[str, str]:
    """What a variant sets, whatever the user gives, by ``section.key`` as for ``--set``."""
    return {key: value for key, value in VARIANTS[variant].items() if key not in KEPT.get(preset or "", ())}


def suited(variant: str, preset: str | None) -> dict[str, str]:
    """Defaults for what a preset sets for the field and a variant with tracks cannot use; the user's ``--set`` wins."""
    given: dict[str, Any] = PRESETS.get(preset or "", {})
    if given.get("train.representation") != "field":
        return {}
    defaults, found = configs.Config().to_dict(), {}
    for name in given:
        section, _, key = name.partition(".")
        if {name, section} & set(UNSUITED.get(variant, ())):
            found[name] = json.dumps(defaults[section][key])
    return found
