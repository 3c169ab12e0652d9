"""Rows of the needs table for the refinement of the cameras, which training has decided."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..config.config import Config
from ..scene import camera_correction
from ..train.refinement import trial
from ..train.refinement.refinement import PARTS
from .draft import Need

UNITS = dict(zip(PARTS, ("px", "px at the border", "intervals between times", "of white"), strict=True))


def rows(record: Mapping[str, Any], config: Config) -> tuple[Need, ...]:
    """Return a row per part of the corrections.

    Args:
        record: Record of the refinement (`refined_dataset.record`); empty if the cameras were not examined.
        config: The run's configuration.
    """
    table = []
    sizes = camera_correction.sizes(record)
    for part in PARTS:
        size = record.get("sizes", {}).get(part)
        on = part in record.get("refined", ())
        reason = f"size on which the pictures agree, {UNITS[part]}" if size is not None else "not examined"
        reason += f"; {sizes[part]}" if part in sizes else ""
        need = Need(part, size or 0.0, trial.least_size(part, config), on, reason, on)
        table.append(need.decided_by_training(getattr(config.needs, part)))
    return tuple(table)
