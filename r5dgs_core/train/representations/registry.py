"""Registry of the motion representations by name.

Each is imported only when it is used; a static scene loads neither tracks nor networks.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from ...config.config import Config
from ...errors import CheckpointError
from ..initialization import initialize
from ..observed_motion import ObservedMotion
from . import static
from .representation import FIELD, STILL, TRACKS, Representation


def make(start: initialize.Start, config: Config, still: bool = False) -> Representation:
    """Create the initial representation: the configured one, or tracks if a field starts from them.

    Args:
        start: Initial state of training.
        config: The run's configuration.
        still: True if nothing moves.
    """
    if still:
        return static.StillRepresentation(start)
    from . import tracks as tracks_representation

    if config.train.representation == TRACKS or config.field.tracks_share > 0:
        return tracks_representation.TracksRepresentation(start, config)
    from . import field

    tracks = tracks_representation.first_tracks(start.tracks)
    field.bring_together(start.gaussians, tracks, start.first_time)
    return field.FieldRepresentation(tracks, start.first_time, config)


def observed_motion(
    name: str,
    tensors: dict[str, Tensor],
    object_ids: np.ndarray,
    observed: np.ndarray,
    labels: np.ndarray,
    config: Config,
) -> ObservedMotion:
    """Call `Representation.observed_motion` of the representation ``name``.

    Raises:
        CheckpointError: This version does not have the representation.
    """
    return _class_of(name).observed_motion(tensors, object_ids, observed, labels, config)


def group_classes(name: str, tensors: dict[str, Tensor]) -> np.ndarray:
    """Call `Representation.group_classes` of the representation ``name``. [G]

    Raises:
        CheckpointError: This version does not have the representation.
    """
    return _class_of(name).group_classes(tensors)


def _class_of(name: str) -> type[Representation]:
    if name == STILL:
        return static.StillRepresentation
    if name == TRACKS:
        from .tracks import TracksRepresentation

        return TracksRepresentation
    if name == FIELD:
        from .field import FieldRepresentation

        return FieldRepresentation
    known = ", ".join((TRACKS, FIELD, STILL))
    raise CheckpointError(f"the checkpoint was trained with representation '{name}'; this version knows {known}")
