"""Two links with exact joints: poses, and a scene in which both are parts of one object."""

from __future__ import annotations

import dataclasses

import numpy as np

from r5dgs_core.motion import joint as joints
from r5dgs_core.motion import models, rotations
from r5dgs_core.motion.joint import Joint
from r5dgs_core.motion_fit.joints import Link
from r5dgs_core.scene.scene import Scene, SceneObject

from . import scenes

BASE = np.array([0.0, 0.0, 1.0])
PIVOTS = np.array([[0.37, 0.0, 1.0], [1.07, 0.1, 0.9]])
POINT = np.array([0.75, 0.05, 1.0])


def relative(kind: str, tau: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Motion of the lower link about `POINT` in the upper one, and its axis: "hinge", "ball", "slider" or "free"."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    still, nowhere = rotations.identity(len(tau)), np.zeros((len(tau), 3))
    if kind == "hinge":
        return rotations.rotvecs_to_quats(tau[:, None] * rng.uniform(1.5, 2.5) * axis), nowhere, axis
    if kind == "ball":
        turns = np.stack([np.sin(5 * tau), 1.5 * tau, 0.7 - 0.7 * np.cos(4 * tau)], -1)
        return rotations.rotvecs_to_quats(turns), nowhere, axis
    if kind == "slider":
        return still, np.outer(0.6 * tau + 0.3 * tau**2, axis), axis
    turned = rotations.rotvecs_to_quats(tau[:, None] * 2 * rng.normal(size=3))
    return turned, np.outer(tau, 0.5 * rng.normal(size=3)) + np.outer(tau**2, rng.normal(size=3)), axis


def links(
    kind: str, times: np.ndarray, rng: np.random.Generator, place: float = 0.0, turn: float = 0.0
) -> tuple[Link, Link, np.ndarray]:
    """Two links, the upper one on a fixed hinge, with noise of their poses, and the axis of the joint."""
    tau = times - scenes.T_MAX
    own_quats, own_moves, axis = relative(kind, tau, rng)
    turned = rotations.rotvecs_to_quats(tau[:, None] * [0.0, rng.uniform(0.8, 1.4), 0.3])
    moved = rotations.rotate(turned, np.tile(PIVOTS[0] - BASE, (len(tau), 1))) - (PIVOTS[0] - BASE)
    lower = joints.composed((turned, moved), PIVOTS[0], (own_quats, own_moves), POINT, PIVOTS[1])
    found = []
    for (quats, moves), pivot in zip(((turned, moved), lower), PIVOTS, strict=True):
        quats = rotations.multiply(rotations.rotvecs_to_quats(turn * rng.normal(size=moves.shape)), quats)
        moves = moves + place * rng.normal(size=moves.shape)
        last = np.flatnonzero(tau == 0)
        if len(last):
            quats = rotations.multiply(quats, rotations.conjugate(quats[last[0]]))
            moves = moves - rotations.rotate(quats, np.tile(moves[last[0]], (len(tau), 1)))
        found.append(Link(quats, moves, pivot, 0.4))
    return found[0], found[1], axis


def make_arm(kind: str = "hinge", **options) -> Scene:
    """The synthetic scene, with the bodies 1 and 2 as the upper and the lower link of object 1."""
    scene, rng = scenes.make_scene(**options), np.random.default_rng(4)
    upper, lower, axis = links(kind, scene.tracks.times, rng)
    model = {
        "hinge": models.MotionModel("ballistic_spin", angular_velocity=2.0 * axis),
        "ball": models.MotionModel("ballistic_spin", angular_velocity=[0.5, 1.5, -1.0]),
        "slider": models.MotionModel("translation", velocity=0.6 * axis),
    }[kind]
    joint = Joint(
        kind, POINT, None if kind == "ball" else axis, None if kind == "ball" else (-0.7, 0.9), model, stop_time=None
    )
    moved, ids = scene.gaussians.means.copy(), scene.gaussians.object_ids.copy()
    groups, poses = list(scene.groups), scene.tracks.poses.copy()
    for row, link in ((1, upper), (2, lower)):
        mine = scene.gaussians.motion_ids == row
        moved[mine] += (link.pivot - scene.groups[row].pivot).astype(np.float32)
        ids[mine] = 1
        groups[row] = dataclasses.replace(groups[row], pivot=link.pivot, object_id=1)
        poses[row] = np.concatenate([link.quats, link.displacements], -1)
    groups[1] = dataclasses.replace(
        groups[1],
        model=models.MotionModel("ballistic_spin", angular_velocity=[0, 1, 0.3], center_offset=BASE - PIVOTS[0]),
    )
    groups[2] = dataclasses.replace(groups[2], parent=1, joint=joint)
    for group in groups:
        if group.follows is not None:
            poses[group.id, :, 4:] = poses[group.follows, :, 4:] @ group.follow_matrix.T
    return dataclasses.replace(
        scene.with_arrays(means=moved, object_ids=ids, track_poses=poses),
        groups=tuple(groups),
        objects=_merged(scene.objects),
    )


def _merged(table: tuple[SceneObject, ...]) -> tuple[SceneObject, ...]:
    """The table with the Gaussians of object 2 in object 1."""
    by_id = {item.id: item for item in table}
    both = dataclasses.replace(by_id[1], count=by_id[1].count + by_id[2].count)
    return tuple(both if item.id == 1 else item for item in table if item.id != 2)
