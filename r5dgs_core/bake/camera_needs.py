"""Rows of the needs table for the refinement of the cameras, which training has decided."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..config.config import Config
from ..scene import camera_correction
from ..train.refinement import trial
from ..train.refinement.refinement import PARTS
from .draft import Need


def rows(record: Mapping[str, Any], config: Config) -> tuple[Need, ...]:
    """Return a row per part of the corrections.

    Args:
        record: Record of the refinement (`refined_dataset.record`); empty if the cameras were not examined.
        config: The run's configuration.
    """
    table = []
    sizes = camera_correction.sizes(record)
    for part in PARTS:
        gain = record.get("gains_db", {}).get(part)
        on = part in record.get("refined", ())
        reason = "gain on pixels that were not fitted, dB" if gain is not None else "not examined"
        reason += f"; {sizes[part]}" if part in sizes else ""
        wanted = getattr(config.needs, part)
        reason = reason if wanted == "auto" else f"set {wanted} by the user; {reason}"
        table.append(Need(part, gain or 0.0, trial.threshold(part, config), on, reason, on))
    return tuple(table)
