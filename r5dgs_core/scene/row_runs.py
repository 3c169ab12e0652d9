"""Runs of consecutive rows with equal ids."""

from __future__ import annotations

import numpy as np


def runs(ids: np.ndarray) -> list[tuple[int, int, int]]:
    """Runs of equal neighbours among ids [N], as (start, stop, id)."""
    if len(ids) == 0:
        return []
    cuts = np.flatnonzero(ids[1:] != ids[:-1]) + 1
    starts = np.concatenate([[0], cuts])
    stops = np.concatenate([cuts, [len(ids)]])
    return [(int(a), int(b), int(ids[a])) for a, b in zip(starts, stops, strict=True)]
