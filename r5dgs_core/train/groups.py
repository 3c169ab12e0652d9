"""Motion groups as a trained representation hands them to baking: poses at the knots, and what they belong to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class GroupTrack:
    """One motion group over the knots, in training coordinates: x -> c + R (x - c) + d from the canonical state.

    Attributes:
        object_id: Object that it belongs to; a shadow's caster.
        role: "pinned", "body" or "shadow".
        center: The fixed centre c. [3]
        quats: Rotations at the knots, unit wxyz. [S, 4]
        displacements: Displacements at the knots. [S, 3]
        observed: Knots at which the object was seen well enough to be placed. [S] bool
        follows: Group whose displacement it takes through ``follow_matrix``, or None.
        follow_matrix: That map. [3, 3]
    """

    object_id: int
    role: str
    center: np.ndarray
    quats: np.ndarray
    displacements: np.ndarray
    observed: np.ndarray
    follows: int | None = None
    follow_matrix: np.ndarray | None = None


@dataclass(frozen=True)
class ObservedMotion:
    """What a trained representation hands to baking: knots [S], groups by id, and the light of the shading [3]."""

    times: np.ndarray
    groups: tuple[GroupTrack, ...]
    light: np.ndarray
