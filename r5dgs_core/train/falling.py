"""Bodies of a scene that fall share one gravity, where the data says which way is up."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..motion import fitting, gravity
from ..scene.scene import MotionGroup
from . import plain_motion

UP = {"blender": np.array([0.0, 0.0, 1.0]), "opengl": np.array([0.0, 1.0, 0.0])}  # others do not say


def share_gravity(
    rows: list[MotionGroup],
    fits: dict[int, tuple[gravity.Track, fitting.Fit]],
    played: list[np.ndarray],
    convention: str,
    names: dict[int, str],
) -> list[MotionGroup]:
    """The groups, those that fall alike with one acceleration between them.

    Args:
        rows: The scene's groups.
        fits: Per index of a group with a motion: its track and what was fitted to it.
        played: Poses of all groups as the scene plays them. [S, 7] each
        convention: World axes of the scene.
        names: Of the objects, by id.
    """
    if convention not in UP or not fits:
        return rows
    tracks, found = zip(*fits.values(), strict=True)
    shared, who = gravity.share(tracks, found, UP[convention])
    rows = list(rows)
    for k in who:
        index = list(fits)[k]
        plain = plain_motion.reduce(names[rows[index].object_id], tracks[k].times, played[index], shared[k])
        rows[index] = dataclasses.replace(rows[index], model=plain.model)
    return rows
