"""Even selection of items, such as cameras, views or times, and the spacing of times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

Item = TypeVar("Item")


def spread(items: Sequence[Item], most: int) -> list[Item]:
    """Select at most ``most`` items, evenly spaced, including the first and the last."""
    at = np.linspace(0, max(len(items) - 1, 0), min(most, len(items))).round()
    return [items[int(k)] for k in at]


def spacing(times: np.ndarray) -> float:
    """Return the median distance of ascending times, 1 if there is only one. [S]"""
    return float(np.median(np.diff(times))) if len(times) > 1 else 1.0
