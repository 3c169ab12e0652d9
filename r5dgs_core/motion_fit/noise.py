"""Noise of a pose track from neighbouring poses, without a motion law."""

from __future__ import annotations

import numpy as np

from ..motion.pose_track import PoseTrack
from .candidates import Noise

IMAGE_NOISE = (
    0.001,
    0.002,
)  # share of the diameter, and rad; smooth errors of tracks from images, which do not scatter
FLOOR = 1e-7  # radii and radians; below this, noise is only rounding
_MEDIAN = 1.538  # median length of three numbers with unit variance


def estimate(track: PoseTrack) -> Noise:
    """Noise from combinations of four neighbouring poses that vanish for motions quadratic in time.

    It is too large for motions that are fast between poses and too small for noise that is correlated in time.
    """
    levels = []
    for path in (track.displacements, track.accumulated_rotation):
        found = []
        for i in range(len(track) - 3):
            x = track.tau[i : i + 4] - track.tau[i]
            x = x / x[-1]
            direction = np.linalg.svd(np.stack([x**0, x, x * x]))[2][-1]
            found.append(np.linalg.norm(direction @ path[i : i + 4]))
        levels.append(max(float(np.median(found)) / _MEDIAN, FLOOR))
    return Noise(*levels)


def of_images(radius: float, place: float = 0.0, turn: float = 0.0) -> tuple[float, float]:
    """Lower bounds of the noise of a track from images, for `model_selection.fit`; at least (place, turn)."""
    return max(place, 2 * radius * IMAGE_NOISE[0]), max(turn, IMAGE_NOISE[1])
