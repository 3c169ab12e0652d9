"""Convex hull of an object, for collisions, and as proxy for shadows in Blender."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Hull:
    """Convex hull of the Gaussians of an object that move with one motion group, in the bind state.

    Attributes:
        object_id: The object.
        motion_id: The motion group.
        vertices: Points whose convex hull it is, 4 to 64, world. [V, 3] float64
        error: Mean distance of its outlines from the silhouettes of the Gaussians, world units; None if unknown.
    """

    object_id: int
    motion_id: int
    vertices: np.ndarray
    error: float | None = None
