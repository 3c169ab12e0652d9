"""Bodies of a scene that fall share one gravity, where the data says which way is up."""

from __future__ import annotations

import numpy as np

from ..motion.models import MotionModel
from ..motion_fit import model_selection, shared_gravity

UP = {"blender": np.array([0.0, 0.0, 1.0]), "opengl": np.array([0.0, 1.0, 0.0])}  # others do not say


def share_gravity(
    fits: dict[int, tuple[shared_gravity.Track, model_selection.Fit]], convention: str
) -> dict[int, MotionModel]:
    """Models of the fits; bodies that fall alike have one acceleration between them.

    Args:
        fits: By the index of a group: its track and what was fitted to it.
        convention: World axes of the scene.
    """
    models = {index: fit.model for index, (_, fit) in fits.items()}
    if convention not in UP or not fits:
        return models
    tracks, found = zip(*fits.values(), strict=True)
    shared, who = shared_gravity.share(tracks, found, UP[convention])
    return models | {list(fits)[k]: shared[k].model for k in who}
