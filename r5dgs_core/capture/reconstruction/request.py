"""Known lenses, poses and scale of cameras before they are reconstructed."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..calibration.lens import Lens
from .board import Board


@dataclass(frozen=True)
class Request:
    """Facts about the cameras of a reconstruction.

    Attributes:
        moving: Names of the cameras that move.
        shared_lens: All cameras have one lens, for example the same model of camera with the same zoom.
        lenses: Known lenses by camera.
        board: Board that is seen in the recordings, or None.
        most_frames: Frames of a moving camera whose poses are reconstructed.
        distance: Names of two fixed cameras and their distance in metres, or None.
        up: Up of the world: see `gauge.upright`.
    """

    moving: frozenset[str] = frozenset()
    shared_lens: bool = False
    lenses: dict[str, Lens] = field(default_factory=dict)
    board: Board | None = None
    most_frames: int = 300
    distance: tuple[str, str, float] | None = None
    up: str = "cameras"
