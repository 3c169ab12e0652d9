"""True poses of a data set in a scene's terms: where each motion group should be, and how far off it is.

The object's frame in the scene and in the ground truth differ by a constant rigid offset, which the observed times at
which the object was seen decide (`metrics.true_motion`). Notation: T times of the ground truth.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from ..data.dataset import GroundTruth
from ..motion import rotations
from ..playback import scene_player
from ..scene.scene import MotionGroup, Scene
from . import metrics

TURNS_DEG = 5.0


@dataclass(frozen=True)
class Body:
    """A motion group and its true motion.

    Attributes:
        object_id: Its object.
        name: Of the object, as the ground truth has it.
        group: The motion group; one of role "pinned" for an object at rest, about the object's own centre.
        size: Diameter of the object, world units.
        times: Of the ground truth. [T]
        motion: True map from the bind state to the world. [T, 4, 4]
        path: Where the group's pivot truly is if the body's own origin tells: right where `motion` is not, as how the
            scene's body lies in the true one is not known. [T, 3]
        turn_error_deg: How far the scene's rotations are from the true ones at the observed times, median, degrees. A
            body that looks the same from all sides may be turned as it likes.
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
        """Whether the images told how it turns: the scene's rotations are within `TURNS_DEG` of the true ones."""
        return self.turn_error_deg <= TURNS_DEG


def bodies(scene: Scene, ground_truth: GroundTruth, *, every: bool = False) -> tuple[Body, ...]:
    """The motion groups of a scene whose true motion is known.

    Args:
        scene: The scene.
        ground_truth: True poses. Where the scene found its objects by itself, places decide which is which.
        every: All bodies of an object, not only the one that carries most of its Gaussians.

    Returns:
        In the order of the ground truth; none where no time of it was observed.
    """
    times = ground_truth.times
    observed = (times <= scene.t_max + 1e-9) & (times >= scene.track_times[0] - 1e-9)
    if not observed.any():
        return ()
    if scene.provenance.get("discovered"):
        ground_truth = _renumbered(scene, ground_truth)
    found = []
    for object_id, name, truth in zip(ground_truth.object_ids, ground_truth.names, ground_truth.matrices, strict=True):
        main = _body(scene, object_id)
        others = [g for g in scene.groups if every and g.role == "body" and g.object_id == object_id]
        for group in others or ([] if main is None else [main]):
            first, last = group.seen or (-np.inf, np.inf)
            seen = observed & (times >= first - 1e-9) & (times <= last + 1e-9)
            predicted = motion(scene, [group], times)[0]
            used = seen if seen.any() else observed
            true = metrics.true_motion(predicted, truth, used, group.pivot)
            here = (predicted @ np.append(group.pivot, 1.0))[:, :3]
            path = truth[:, :3, 3] + (here - truth[:, :3, 3])[used].mean(axis=0)
            _, angles = metrics.pose_errors(predicted[used], true[used], group.pivot)
            size = _size(scene, group)
            found.append(Body(object_id, name, group, size, times, true, path, float(np.median(angles))))
    return tuple(found)


def motion(scene: Scene, groups: Sequence[MotionGroup], times: np.ndarray) -> np.ndarray:
    """How a scene moves groups: maps from the bind state to the world. G groups, [T] -> [G, T, 4, 4]"""
    poses = [scene_player.group_poses(scene, float(t)) for t in times]
    return np.stack([np.stack([matrix(group.pivot, q[group.id], d[group.id]) for q, d in poses]) for group in groups])


def matrix(pivot: np.ndarray, quat: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Map from the bind state to the world: x -> p + R (x - p) + d. [4, 4]"""
    result = np.eye(4)
    result[:3, :3] = rotations.quats_to_rotmats(quat)
    pivot = np.asarray(pivot, np.float64)
    result[:3, 3] = pivot + displacement - result[:3, :3] @ pivot
    return result


def pose(pivot: np.ndarray, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse of `matrix`: unit wxyz [..., 4] and displacement of the pivot [..., 3] of maps [..., 4, 4]."""
    pivot = np.asarray(pivot, np.float64)
    turned = np.einsum("...ij,j->...i", motion[..., :3, :3], pivot)
    return rotations.rotmats_to_quats(motion[..., :3, :3]), turned + motion[..., :3, 3] - pivot


def _renumbered(scene: Scene, ground_truth: GroundTruth) -> GroundTruth:
    """The ground truth of those objects that a scene found by itself, with the ids that they have there.

    Nobody named what was found, so places decide: at the time of the truth that is nearest to the bind state each
    object is the one that is nearest to it, no further off than the radius of that group.
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
    """The motion group that carries most of an object's Gaussians; shadows do not count."""
    candidates = [group for group in scene.groups if group.object_id == object_id and group.role == "body"]
    if not candidates:  # an object at rest may be a member of the pinned group
        pinned = scene.groups[0] if scene.groups else None
        mine = scene.means[scene.object_ids == object_id]
        if pinned is None or not len(mine):
            return None
        center = mine.mean(axis=0).astype(np.float64)
        return MotionGroup(pinned.id, object_id, "pinned", -1, center, pinned.model)
    members = [int(((scene.object_ids == object_id) & (scene.motion_ids == group.id)).sum()) for group in candidates]
    return candidates[int(np.argmax(members))]


def _size(scene: Scene, group: MotionGroup) -> float:
    """Twice the radius of a group; that of an object at rest holds nine of ten of its Gaussians."""
    if group.role == "body":
        return 2 * group.model.radius
    distances = np.linalg.norm(scene.means[scene.object_ids == group.object_id] - group.pivot, axis=-1)
    if not len(distances):
        return 2 * group.model.radius
    return 2 * max(float(np.quantile(distances, 0.9)), 1e-9 * scene.extent)
