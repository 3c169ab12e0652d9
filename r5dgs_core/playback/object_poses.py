"""Poses and velocities of the objects of a scene at any time, with the confidence band of predicted ones.

The frame of an object has its origin at the anchor of its motion group, as in Blender: the pivot, or the point of the
joint of a part. At t_max its axes are those of the world.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from ..motion import rotations
from ..scene.scene import MotionGroup, Scene, SceneObject
from .scene_player import Player

_STEP = 1e-5  # of the forward differences for velocities, as a fraction of the observed span


@dataclass(frozen=True)
class ObjectPoses:
    """Motion of one object, or of one part of it, at T times. Units are those of the scene, world frame.

    Attributes:
        object_id: Id of the object.
        name: Name of the object.
        part: Number of the part from 1 on; None for an object without parts.
        group: Motion group; 0 for an object that never moves.
        positions: Origin of the object's frame. [T, 3]
        quats: Rotation from the object's frame to the world, unit wxyz with continuous signs. [T, 4]
        velocities: Velocity of the origin, per unit of time. At an event, that after it. [T, 3]
        angular_velocities: Angular velocity, rad per unit of time. [T, 3]
        half_widths: Half width of the confidence band of a point of the object. NaN up to t_max, or if unknown. [T]
        half_angles: Half width of the band of the rotation, rad; NaN likewise. [T]
        level: Probability that the truth lies inside the band; None if the band is unknown.
    """

    object_id: int
    name: str
    part: int | None
    group: int
    positions: np.ndarray
    quats: np.ndarray
    velocities: np.ndarray
    angular_velocities: np.ndarray
    half_widths: np.ndarray
    half_angles: np.ndarray
    level: float | None

    @property
    def label(self) -> str:
        """Name of the object and number of the part."""
        return self.name if self.part is None else f"{self.name} (part {self.part})"


def at(scene: Scene, times: Sequence[float], object_ids: Collection[int] | None = None) -> list[ObjectPoses]:
    """Poses of the objects at scene times, which may exceed t_max.

    An object that never moves has its frame at the centre of its Gaussians.

    Args:
        scene: The scene.
        times: Scene times, in any order.
        object_ids: Objects to include; None for all but the background.
    """
    player = Player(scene)
    observed = scene.tracks.times
    step = _STEP * float(observed[-1] - observed[0]) or _STEP
    samples = [[player.group_poses(t + k * step) for t in times] for k in range(3)]
    quats = np.array([[q for q, _ in row] for row in samples])  # [3, T, G, 4]
    moves = np.array([[d for _, d in row] for row in samples])  # [3, T, G, 3]
    predicted = np.asarray(times) > scene.t_max
    found = []
    for item in scene.objects:
        if item.id <= 0 or (object_ids is not None and item.id not in object_ids):
            continue
        own = scene.bodies(item.id)
        for number, group in enumerate(own, 1):
            q = quats[:, :, group.id]
            p = group.pivot + rotations.rotate(q, group.home - group.pivot) + moves[:, :, group.id]
            part = number if len(own) > 1 else None
            found.append(_moving(item, part, group, q, p, step, np.asarray(times, np.float64), predicted))
        if not own and item.count:
            found.append(_resting(scene, item, len(times)))
    return found


def _moving(
    item: SceneObject,
    part: int | None,
    group: MotionGroup,
    quats: np.ndarray,
    positions: np.ndarray,
    step: float,
    times: np.ndarray,
    predicted: np.ndarray,
) -> ObjectPoses:
    """Motion of a group from its poses at each time, one step later and two steps later. [3, T, 4], [3, T, 3]"""
    once, twice = (rotations.quats_to_rotvecs(rotations.multiply(q, rotations.conjugate(quats[0]))) for q in quats[1:])
    band = group.history.band
    unknown = np.full(len(times), np.nan)
    widths, angles = (unknown, unknown) if band is None else (band.widths(times), band.angles(times))
    return ObjectPoses(
        object_id=item.id,
        name=item.name,
        part=part,
        group=group.id,
        positions=positions[0],
        quats=rotations.make_continuous(quats[0]),
        velocities=(4 * positions[1] - 3 * positions[0] - positions[2]) / (2 * step),
        angular_velocities=(4 * once - twice) / (2 * step),
        half_widths=np.where(predicted, widths, np.nan),
        half_angles=np.where(predicted, angles, np.nan),
        level=None if band is None else band.level,
    )


def _resting(scene: Scene, item: SceneObject, count: int) -> ObjectPoses:
    """Motion of an object without a group of its own."""
    center = scene.gaussians.means[item.start : item.start + item.count].mean(0, dtype=np.float64)
    still, unknown = np.zeros((count, 3)), np.full(count, np.nan)
    places, quats = np.tile(center, (count, 1)), rotations.identity(count)
    return ObjectPoses(item.id, item.name, None, 0, places, quats, still, still, unknown, unknown, None)
