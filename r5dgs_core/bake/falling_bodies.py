"""Shared gravity of the falling bodies of a scene, if the world convention defines the up axis."""

from __future__ import annotations

import numpy as np

from ..motion_fit import model_selection, shared_gravity

UP_AXIS = {"blender": np.array([0.0, 0.0, 1.0]), "opengl": np.array([0.0, 1.0, 0.0])}


def share_gravity(
    fits: dict[int, tuple[shared_gravity.Track, model_selection.Fit]], convention: str
) -> dict[int, model_selection.Fit]:
    """Return the fits, with one common acceleration for bodies that fall alike.

    Args:
        fits: Track and fit of each moving group, by group index.
        convention: World convention of the scene; gravity is shared only if its up axis is known.
    """
    shared = [fit for _, fit in fits.values()]
    if convention in UP_AXIS and fits:
        shared, _ = shared_gravity.share([track for track, _ in fits.values()], shared, UP_AXIS[convention])
    return dict(zip(fits, shared, strict=True))
