"""Motion of a group between its observed poses: cubic, with jumps of the velocity at observed events."""

from __future__ import annotations

import numpy as np

from ..motion import impacts
from ..motion.cubic_curves import Curves, Keys
from ..scene.scene import MotionGroup, Scene

JUMPS = ("start", "stop", "impact")  # kinds of events at which the velocity may jump


def jumps(scene: Scene, group: MotionGroup) -> list[float]:
    """Scene times at which the velocity of a group may jump; a follower has those of its leader, a part none."""
    if group.joint is not None:
        return []
    history = (group if group.follows is None else scene.groups[group.follows]).history
    return [event.time for event in history.events if event.kind in JUMPS]


def curves(scene: Scene, group: MotionGroup, quats: np.ndarray, displacements: np.ndarray) -> Curves:
    """Keys at the observed times, and at jumps between them.

    Args:
        scene: The scene.
        group: The group.
        quats: Its rotations at the observed times, with continuous signs. [S, 4]
        displacements: Its displacements. [S, 3]
    """
    times, found = np.asarray(scene.tracks.times, np.float64), jumps(scene, group)
    return Curves(impacts.keys(times, displacements, found), _unit(impacts.keys(times, quats, found), times))


def _unit(keys: Keys, times: np.ndarray) -> Keys:
    """Keys whose quaternions between the observed times have length 1, as glTF prescribes, with the same spins."""
    norms = np.where(np.isin(keys.times, times), 1.0, np.linalg.norm(keys.values, axis=1))[:, None]
    return Keys(keys.times, keys.values / norms, keys.left_slopes / norms, keys.right_slopes / norms)
