"""Registry of the motion representations by name.

Each is imported only when it is used; a static scene loads neither tracks nor networks.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...config.config import Config
from ...errors import CheckpointError
from ...model.gaussians import Gaussians
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


def leave_tracks(
    motion: Representation, gaussians: Gaussians, first: int, config: Config, draw: torch.Generator
) -> Representation:
    """Return the field that continues from trained tracks, see `field.from_tracks`."""
    from . import field
    from .tracks import TracksRepresentation

    assert isinstance(motion, TracksRepresentation)
    return field.from_tracks(motion.tracks, motion.light, gaussians, first, config, draw)


def for_state(motion: Representation, name: str, first: int, config: Config) -> Representation:
    """Return the representation that continues from a checkpoint of the representation ``name``.

    Args:
        motion: The run's initial representation.
        name: Representation of the checkpoint.
        first: Knot at which the Gaussians of a field are canonical.
        config: The run's configuration.

    Returns:
        ``motion``, or a field if the run of the checkpoint has already switched from tracks to a field.

    Raises:
        CheckpointError: The checkpoint has another representation than the configuration.
    """
    if config.train.representation == name == FIELD and motion.name == TRACKS:
        from . import field
        from .tracks import TracksRepresentation

        assert isinstance(motion, TracksRepresentation)
        return field.FieldRepresentation(motion.tracks, first, config)
    if name != motion.name:
        raise CheckpointError(
            f"the checkpoint was trained with representation '{name}', the configuration asks for '{motion.name}'"
        )
    return motion


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
