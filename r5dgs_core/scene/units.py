"""Size of a scene's units of time and length."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

LIMIT = 1e12  # a unit is at most this, and at least its inverse
KEYS = ("seconds_per_unit", "meters_per_unit")


@dataclass(frozen=True)
class Units:
    """Units of a scene or data set.

    Attributes:
        seconds_per_unit: Seconds per unit of scene time, or None if unknown.
        meters_per_unit: Metres per unit of the world, or None if unknown.
    """

    seconds_per_unit: float | None = None
    meters_per_unit: float | None = None

    def to_json(self) -> dict[str, float]:
        """Return the known units by key."""
        return {key: value for key in KEYS if (value := getattr(self, key)) is not None}


def read(values: Mapping[str, Any]) -> Units:
    """Read the units among the keys of a file; missing keys and null are unknown.

    Raises:
        ValueError: A value is no positive number within `LIMIT`.
    """
    for key in KEYS:
        value = values.get(key)
        good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if value is not None and not (good and 1 / LIMIT <= value <= LIMIT):
            raise ValueError(f"{key!r} must be a positive number up to {LIMIT:g} or null, found {value!r:.60}")
    return Units(*(None if values.get(key) is None else float(values[key]) for key in KEYS))
