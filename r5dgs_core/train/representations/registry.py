"""Registry of the motion representations by name.

Each is imported only when it is used; a static scene loads neither tracks nor networks.
"""

from __future__ import annotations

from ...config.config import Config
from ...errors import CheckpointError
from ..initialization import initialize
from . import still
from .representation import FIELD, STILL, TRACKS, Representation


def by_name(name: str) -> type[Representation]:
    """Return the representation of a name in checkpoints. Raises CheckpointError if this version does not have it."""
    if name == STILL:
        return still.StillRepresentation
    if name == TRACKS:
        from .tracks import TracksRepresentation

        return TracksRepresentation
    if name == FIELD:
        from .field import FieldRepresentation

        return FieldRepresentation
    known = ", ".join((TRACKS, FIELD, STILL))
    raise CheckpointError(f"the checkpoint was trained with representation '{name}'; this version supports {known}")


def configured(config: Config, at_rest: bool = False) -> type[Representation]:
    """Return the final representation of a run: the configured one, or that of a static scene if ``at_rest``."""
    return by_name(STILL if at_rest else config.train.representation)


def make(motion: type[Representation], start: initialize.InitialState, config: Config) -> Representation:
    """Create the initial representation: the configured one, or tracks if a field starts from them.

    Args:
        motion: Result of `configured`.
        start: Initial state of training.
        config: The run's configuration.
    """
    if not motion.moves:
        return still.StillRepresentation(start)
    from . import tracks as tracks_representation

    if motion.name == TRACKS or config.field.tracks_share > 0:
        return tracks_representation.TracksRepresentation(start, config)
    from . import field, field_handover

    tracks = tracks_representation.first_tracks(start.tracks)
    field_handover.pose_at_knot(start.gaussians, tracks, start.first_time)
    return field.FieldRepresentation(tracks, start.first_time, config)
