"""Shared gravity of the falling bodies of a scene, if the world convention defines the up axis."""

from __future__ import annotations

import numpy as np

from ..motion.models import MotionModel
from ..motion_fit import model_selection, shared_gravity

UP = {"blender": np.array([0.0, 0.0, 1.0]), "opengl": np.array([0.0, 1.0, 0.0])}  # up axis


def share_gravity(
    fits: dict[int, tuple[shared_gravity.Track, model_selection.Fit]], convention: str
) -> dict[int, MotionModel]:
    """Return the fitted models, with one common acceleration for bodies that fall alike.

    Args:
        fits: Track and fit of each moving group, by group index.
        convention: World convention of the scene; gravity is shared only if its up axis is known.
    """
    models = {index: fit.model for index, (_, fit) in fits.items()}
    if convention not in UP or not fits:
        return models
    tracks, found = zip(*fits.values(), strict=True)
    shared, who = shared_gravity.share(tracks, found, UP[convention])
    return models | {list(fits)[k]: shared[k].model for k in who}
