"""Horizontal plane under the objects of a scene, for files of simulators.

A scene file holds no ground. The plane is at the lowest point of the hulls that rest at t_max or at the end of a motion
with contacts, and not above any observed place of a hull, so that no body starts inside it. It has no edges.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..motion import knots, rotations
from ..playback.scene_player import Player
from ..scene import cameras, sampling
from ..scene.hull import Hull
from ..scene.scene import MotionGroup, Scene

_TIMES = 64  # observed times that are tested
LOSS = "the ground: a horizontal plane under the lowest object replaces it"
MISSING = "the support of bodies: no object rests; add a plane in the simulator"


def height(scene: Scene, hulls: Iterable[Hull]) -> float | None:
    """Return the height of the plane along the upward axis, scene units, or None if nothing rests."""
    hulls, up = list(hulls), cameras.WORLD_TO_BLENDER[scene.world_convention][2]
    player = Player(scene)
    ends = {hull.motion_id: _rest_time(scene, scene.groups[hull.motion_id]) for hull in hulls}
    resting = [_lowest(player, hull, end, up) for hull in hulls if (end := ends[hull.motion_id]) is not None]
    if not resting:
        return None
    seen = sampling.spread(scene.tracks.times.tolist(), _TIMES)
    return min(*resting, *(_lowest(player, hull, t, up) for t in seen for hull in hulls))


def _rest_time(scene: Scene, group: MotionGroup) -> float | None:
    """Return a time from t_max on at which a group is at rest, or None if it never is."""
    if group.parent is not None or group.follows is not None:
        return None
    if group.model.kind == "static":
        return scene.t_max
    path = group.model.knots
    if path is None or path[-1, knots.VELOCITY[1]].any() or path[-1, knots.SPIN[1]].any():
        return None
    return scene.t_max + float(path[-1, knots.TIME])


def _lowest(player: Player, hull: Hull, t: float, up: np.ndarray) -> float:
    """Height of the lowest vertex of a hull at a time."""
    pivot = player.scene.groups[hull.motion_id].pivot
    quats, moves = (part[hull.motion_id] for part in player.group_poses(t))
    return float(((pivot + rotations.rotate(quats, hull.vertices - pivot) + moves) @ up).min())
