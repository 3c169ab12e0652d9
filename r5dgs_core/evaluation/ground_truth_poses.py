"""True poses of a data set in the frame of a scene: true motion of each motion group, and its error.

The object frames in the scene and in the ground truth differ by a constant rigid offset, which is estimated from the
observed times at which the object was seen (`metrics.true_motion`). An object may have several true bodies and several
groups, its parts; those that move alike are compared. Notation: T times of the ground truth.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from ..data.dataset import GroundTruth
from ..motion import se3
from ..playback import scene_player
from ..scene.scene import MotionGroup, Scene
from . import metrics

TURNS_DEG = 5.0  # median rotation error up to which rotation counts as observed


@dataclass(frozen=True)
class Body:
    """A motion group and its true motion.

    Attributes:
        object_id: Id of the object.
        name: Name of the body in the ground truth.
        group: The motion group; for an object at rest, one of role "pinned" about the object's own center.
        size: Diameter of the object, world units.
        times: Times of the ground truth. [T]
        motion: True map from the bind state to the world. [T, 4, 4]
        path: True position of the group's pivot, derived from the path of the true body's origin alone. Unlike
            `motion`, it does not depend on the rotation offset between both object frames. [T, 3]
        turn_error_deg: Median angle between the scene's and the true rotations at the observed times, degrees. It may
            be large for a body that looks the same from all sides.
    """

    object_id: int
    name: str
    group: MotionGroup
    size: float
    times: np.ndarray
    motion: np.ndarray
    path: np.ndarray
    turn_error_deg: float

    @property
    def turn_seen(self) -> bool:
        """True if the images determine the rotation: the scene's rotations are within `TURNS_DEG` of the true ones."""
        return self.turn_error_deg <= TURNS_DEG


def bodies(scene: Scene, ground_truth: GroundTruth, *, every: bool = False) -> tuple[Body, ...]:
    """Return the motion groups of a scene whose true motion is known.

    Args:
        scene: The scene.
        ground_truth: True poses. Discovered objects of a scene are matched to the true ones by position.
        every: Return all groups of an object. By default, there is one for each of its true bodies: the one with
            most of its Gaussians if there is a single true body, else the one that moves alike.

    Returns:
        Bodies in the order of the ground truth; empty if no time of the ground truth was observed.
    """
    times = ground_truth.times
    observed = (times <= scene.t_max + 1e-9) & (times >= scene.tracks.times[0] - 1e-9)
    if not observed.any():
        return ()
    if scene.provenance.get("discovered"):
        ground_truth = _renumbered(scene, ground_truth)
    found = []
    for object_id in dict.fromkeys(ground_truth.object_ids):
        rows = [row for row, key in enumerate(ground_truth.object_ids) if key == object_id]
        main = _body(scene, object_id)
        if main is None:
            continue
        parts = scene.bodies(object_id)
        groups = parts if parts and (every or len(rows) > 1) else [main]
        pairs = [[_paired(scene, ground_truth, group, row, observed) for row in rows] for group in groups]
        found += _matched(pairs, every)
    return tuple(found)


def _paired(
    scene: Scene, ground_truth: GroundTruth, group: MotionGroup, row: int, observed: np.ndarray
) -> tuple[Body, float]:
    """Return a group with the true motion of a row, and the distance of both in the observed time, in sizes."""
    times, truth = ground_truth.times, ground_truth.matrices[row]
    first, last = group.seen or (-np.inf, np.inf)
    seen = observed & (times >= first - 1e-9) & (times <= last + 1e-9)
    predicted = motion(scene, [group], times)[0]
    used = seen if seen.any() else observed
    true = metrics.true_motion(predicted, truth, used, group.pivot)
    here = (predicted @ np.append(group.pivot, 1.0))[:, :3]
    path = truth[:, :3, 3] + (here - truth[:, :3, 3])[used].mean(axis=0)
    places, angles = metrics.pose_errors(predicted[used], true[used], group.pivot)
    name, size = ground_truth.names[row], _size(scene, group)
    body = Body(ground_truth.object_ids[row], name, group, size, times, true, path, float(np.median(angles)))
    return body, float(np.mean(places) / size + np.mean(np.radians(angles)))


def _matched(pairs: Sequence[Sequence[tuple[Body, float]]], every: bool) -> list[Body]:
    """Return the nearest pairs of groups and rows of one object: one for each group, or one to one, ordered by row."""
    if every:
        return [min(own, key=lambda pair: pair[1])[0] for own in pairs]
    costs = np.array([[cost for _, cost in own] for own in pairs])
    rows, groups = optimize.linear_sum_assignment(costs.T)
    return [pairs[group][row][0] for row, group in zip(rows, groups, strict=True)]


def motion(scene: Scene, groups: Sequence[MotionGroup], times: np.ndarray) -> np.ndarray:
    """Return the motion of groups as maps from the bind state to the world. G groups, [T] -> [G, T, 4, 4]"""
    player = scene_player.Player(scene)
    poses = [player.group_poses(float(t)) for t in times]
    return np.stack([np.stack([se3.pose_to_matrix(g.pivot, q[g.id], d[g.id]) for q, d in poses]) for g in groups])


def _renumbered(scene: Scene, ground_truth: GroundTruth) -> GroundTruth:
    """Return the ground truth of the objects that a scene discovered, renumbered to the scene's ids.

    Discovered objects have no names, so they are matched by position: at the true time nearest to the bind state,
    objects and groups are assigned one to one with minimal total distance. Pairs further apart than the radius of the
    group are dropped.
    """
    bodies = [group for group in scene.groups if group.role == "body" and group.object_id > 0]
    at = int(np.argmin(np.abs(ground_truth.times - scene.t_max)))
    places = ground_truth.matrices[:, at, :3, 3]
    pivots = np.array([group.pivot for group in bodies]).reshape(-1, 3)
    distances = np.linalg.norm(places[:, None] - pivots, axis=-1)  # [true objects, bodies]
    pairs = zip(*optimize.linear_sum_assignment(distances), strict=True)
    kept = [(i, k) for i, k in pairs if distances[i, k] <= bodies[k].model.radius]
    return dataclasses.replace(
        ground_truth,
        object_ids=tuple(bodies[k].object_id for _, k in kept),
        names=tuple(ground_truth.names[i] for i, _ in kept),
        matrices=ground_truth.matrices[[i for i, _ in kept]],
    )


def _body(scene: Scene, object_id: int) -> MotionGroup | None:
    """Return the motion group with most of an object's Gaussians, without shadows; None if it has no Gaussians."""
    candidates = [group for group in scene.groups if group.object_id == object_id and group.role == "body"]
    if not candidates:  # an object at rest may be a member of the pinned group
        pinned = scene.groups[0] if scene.groups else None
        mine = scene.gaussians.means[scene.gaussians.object_ids == object_id]
        if pinned is None or not len(mine):
            return None
        center = mine.mean(axis=0).astype(np.float64)
        return MotionGroup(pinned.id, object_id, "pinned", -1, center, pinned.model)
    members = [
        int(((scene.gaussians.object_ids == object_id) & (scene.gaussians.motion_ids == group.id)).sum())
        for group in candidates
    ]
    return candidates[int(np.argmax(members))]


def _size(scene: Scene, group: MotionGroup) -> float:
    """Return twice the radius of a group; for an object at rest, the radius that holds 90 % of its Gaussians."""
    if group.role == "body":
        return 2 * group.model.radius
    distances = np.linalg.norm(
        scene.gaussians.means[scene.gaussians.object_ids == group.object_id] - group.pivot, axis=-1
    )
    if not len(distances):
        return 2 * group.model.radius
    return 2 * max(float(np.quantile(distances, 0.9)), 1e-9 * scene.extent)
