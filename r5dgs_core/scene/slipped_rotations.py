"""Observed rotations that slipped by a turn. Fits of smooth motions allow for slips; fits of contacts do not.

Baking finds them with the smooth laws and records them in the provenance of a scene.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..motion.history import UNKNOWN_TURN
from .scene import Scene

RECORD = "slipped_rotations"  # key of the provenance

Spans = Mapping[int, Sequence[tuple[float, float]]]


def record(slipped: Spans) -> dict[str, Any]:
    """Part of the provenance: first and last time by group; null for no end. Empty without slips."""
    ends = {str(index): [[_finite(t) for t in span] for span in spans] for index, spans in slipped.items()}
    return {RECORD: ends} if ends else {}


def recorded(scene: Scene) -> Spans:
    """Return the first and last time of rotations that slipped, by group, from the provenance of a scene."""
    found: dict[int, list[tuple[float, float]]] = {}
    # The provenance is a free JSON object.
    with contextlib.suppress(AttributeError, TypeError, ValueError, OverflowError):
        for index, spans in scene.provenance.get(RECORD, {}).items():
            limits = [(-math.inf if a is None else float(a), math.inf if b is None else float(b)) for a, b in spans]
            if 0 < int(index) < len(scene.groups):
                found[int(index)] = limits
    return found


def renumbered(scene: Scene, sources: Sequence[int]) -> dict[str, Any]:
    """Return the provenance of a scene with other groups.

    Args:
        scene: The scene with the former groups.
        sources: Former number of each new group. [G]
    """
    if RECORD not in scene.provenance or list(sources) == list(range(len(scene.groups))):
        return scene.provenance
    found = recorded(scene)
    others = {name: value for name, value in scene.provenance.items() if name != RECORD}
    return others | record({new: found[old] for new, old in enumerate(sources) if old in found})


def unknown(scene: Scene, slipped: Spans) -> Scene:
    """Return the scene with the error `UNKNOWN_TURN` of the rotations that slipped."""
    groups = list(scene.groups)
    for index, spans in slipped.items():
        past, times = groups[index].history, scene.tracks.times
        if past.errors is not None:
            turn = np.array(past.errors.turn)
            for first, last in spans:
                turn[(times > first) & (times < last) & (turn < UNKNOWN_TURN)] = UNKNOWN_TURN
            errors = dataclasses.replace(past.errors, turn=tuple(turn.tolist()))
            groups[index] = dataclasses.replace(groups[index], history=dataclasses.replace(past, errors=errors))
    return dataclasses.replace(scene, groups=tuple(groups))


def _finite(time: float) -> float | None:
    return float(time) if math.isfinite(time) else None
