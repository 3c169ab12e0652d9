"""The bind state of a scene: Gaussians at t_max, and their groups' poses relative to it.

Notation: in training a body moves x -> c + R_s (x - c) + d_s. With the bind state at the last knot T and any pivot p,
the same motion is x_bind -> p + Q_s (x_bind - p) + D_s with Q_s = R_s R_T^-1 and D_s = c + d_s + Q_s (p - c - d_T) - p.
Colours are transferred to the bind state by `train.representations.shading`.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ..errors import ConfigError
from ..motion import rotations
from ..motion.models import MotionModel
from ..scene import presence, spherical_harmonics, visibility
from ..scene.scene import MotionGroup, Scene
from ..scene.splats import to_opacities
from ..shapes import silhouette_hull, solid
from ..train import observed_motion
from ..train.representations import shading as shading_vectors
from . import track_checks
from .draft import BoundScene, Context, ObservedScene

_TURN, _MOVE = 0.05, 0.1  # rad and radii from the last pose, up to which the motion of a body may be an error
_ARRAYS = ("means", "quats", "sh", "shading", "shading_rest", "residual_offsets", "residual_quats")  # of `Scene`
_COLUMNS = ("means", "quats", "sh", "shading", "rest")  # of `Cloud`


def bind(observed: ObservedScene, context: Context) -> BoundScene:
    """Transform the Gaussians of a checkpoint to the bind state."""
    cloud, motion, norm, wanted = observed.cloud, observed.motion, context.norm, context.wanted
    names = {int(i): context.dataset.object_names.get(int(i), f"object {i}") for i in context.tensors["object_ids"]}
    means, quats, sh, shading, rest = (getattr(cloud, name).copy() for name in _COLUMNS)
    groups, trained, pivots, played = [], [], [], []
    opacities = to_opacities(cloud.opacity_logits)
    for index, group in enumerate(motion.groups):
        group = track_checks.sound(group, names.get(group.object_id, "background"))
        members = cloud.motion_ids == index
        center = norm.points_to_world(group.center)
        path = group.displacements * norm.scale
        q, d = group.quats[-1], path[-1]
        means[members] = center + rotations.rotate(q, means[members] - center) + d
        quats[members] = rotations.multiply(q, quats[members])
        turned = spherical_harmonics.rotate(sh[members], q)
        sh[members], shading[members], rest[members] = shading_vectors.rebind(
            turned, shading[members], rest[members], q, observed.light
        )
        pivot = _middle(means[members], opacities[members], center + d)
        if group.role == "body" and _moves(group.quats, path, _radius(means[members], opacities[members], pivot)):
            own = members & (cloud.object_ids == group.object_id)
            found = _center_of_mass(means[own], quats[own], cloud.log_scales[own], opacities[own])
            pivot = pivot if found is None else found
        poses = _relative(group.quats, path, center, pivot)
        if group.observed.any() and not motion.smooth:  # before an object is seen its pose is unknown
            first = int(np.argmax(group.observed))
            poses[:first] = poses[first]
        trained.append(poses.copy())
        pivots.append(pivot)
        radius = max(_radius(means[members], opacities[members], pivot), 1e-9 * norm.scale)
        if wanted.rotation == "off":
            poses[:, :4] = rotations.identity()
        if group.role == "pinned" or wanted.tracks == "off":
            poses[:] = [1.0, 0, 0, 0, 0, 0, 0]
        played.append(poses)
        anchor = _anchor(np.flatnonzero(members), means[members], opacities[members], pivot)
        groups.append(_motion_group(index, group, motion.times, pivot, MotionModel(radius=radius), anchor))
    bound = dataclasses.replace(cloud, means=means, quats=quats, sh=sh, shading=shading, rest=rest)
    return BoundScene(bound, tuple(groups), np.stack(trained), np.stack(pivots), np.stack(played))


def rebind(scene: Scene, poses: np.ndarray) -> Scene:
    """Return the scene with other poses [G, S, 7], in the bind state of each group's last pose."""
    if np.array_equal(poses, scene.tracks.poses):
        return scene
    arrays = {name: array.copy() for name, array in scene.arrays().items() if name in _ARRAYS}
    if "shading" in arrays:
        arrays.setdefault("shading_rest", np.ones(len(scene.gaussians.means), np.float32))
    groups, poses = list(scene.groups), poses.copy()
    for g in scene.groups:
        track = poses[g.id]
        q, d = track[-1, :4].copy(), track[-1, 4:].copy()
        if (track[:, :4] == q).all():
            track[:, :4] = rotations.identity()
        else:
            track[:, :4] = rotations.normalize(rotations.multiply(track[:, :4], rotations.conjugate(q)))
        track[:, 4:] -= d
        track[-1, :4] = rotations.identity()
        if np.any(q[1:] != 0) or np.any(d != 0):
            _move(scene, arrays, np.flatnonzero(scene.gaussians.motion_ids == g.id), g.pivot, q, d)
            groups[g.id] = dataclasses.replace(g, pivot=g.pivot + d)
    if scene.shading is not None and scene.shading.rest is None and (arrays["shading_rest"] == 1).all():
        del arrays["shading_rest"]
    return dataclasses.replace(scene.with_arrays(track_poses=poses, **arrays), groups=tuple(groups))


def _move(
    scene: Scene, arrays: dict[str, np.ndarray], rows: np.ndarray, pivot: np.ndarray, q: np.ndarray, d: np.ndarray
) -> None:
    """Move Gaussians to another bind state, in place: a rotation q [4] about the pivot [3] and a shift d [3]."""
    means = arrays["means"][rows].astype(np.float64)
    arrays["means"][rows] = pivot + rotations.rotate(q, means - pivot) + d
    if not np.any(q[1:] != 0):
        return
    arrays["quats"][rows] = rotations.normalize(rotations.multiply(q, arrays["quats"][rows].astype(np.float64)))
    sh = spherical_harmonics.rotate(arrays["sh"][rows].astype(np.float64), q)
    if scene.shading is not None:
        vectors, rest = (arrays[name][rows].astype(np.float64) for name in ("shading", "shading_rest"))
        sh, arrays["shading"][rows], arrays["shading_rest"][rows] = shading_vectors.rebind(
            sh, vectors, rest, q, scene.shading.light
        )
    arrays["sh"][rows] = sh
    if scene.residuals is not None:
        own = np.isin(scene.residuals.rows, rows)
        arrays["residual_offsets"][own] = rotations.rotate(q, arrays["residual_offsets"][own].astype(np.float64))
        turns = rotations.multiply(q, arrays["residual_quats"][own].astype(np.float64))
        arrays["residual_quats"][own] = rotations.normalize(rotations.multiply(turns, rotations.conjugate(q)))


def _relative(quats: np.ndarray, path: np.ndarray, center: np.ndarray, pivot: np.ndarray) -> np.ndarray:
    """Return poses about the pivot relative to the bind state, exactly the identity at the last knot. [S, 7]

    Args:
        quats: Rotations about ``center``, wxyz. [S, 4]
        path: Displacements of ``center``, world. [S, 3]
        center: The canonical centre, world. [3]
        pivot: The pivot in the bind state, world. [3]
    """
    relative = rotations.multiply(quats, rotations.conjugate(quats[-1]))
    relative = rotations.make_continuous(rotations.normalize(relative))
    shift = center + path + rotations.rotate(relative, pivot - center - path[-1]) - pivot
    relative[-1], shift[-1] = [1.0, 0, 0, 0], 0.0
    return np.concatenate([relative, shift], axis=1)


def _radius(means: np.ndarray, opacities: np.ndarray, pivot: np.ndarray) -> float:
    """Return the radius of the visible members; 1 without members."""
    if len(means) == 0:
        return 1.0
    return observed_motion.radius(means[visibility.seen(opacities)], pivot)


def _anchor(rows: np.ndarray, means: np.ndarray, opacities: np.ndarray, pivot: np.ndarray) -> int:
    """Return the row of the visible member nearest to the pivot, -1 without members."""
    if len(rows) == 0:
        return -1
    distance = np.where(visibility.seen(opacities), np.linalg.norm(means - pivot, axis=1), np.inf)
    return int(rows[np.argmin(distance)])


def _motion_group(
    index: int,
    group: observed_motion.GroupTrack,
    times: np.ndarray,
    pivot: np.ndarray,
    model: MotionModel,
    anchor: int,
) -> MotionGroup:
    """Return the scene's `MotionGroup` of a track whose members all move rigidly with it."""
    seen = times[group.observed]
    return MotionGroup(
        index,
        group.object_id,
        group.role,
        anchor,
        pivot,
        model,
        group.follows,
        group.follow_matrix,
        seen=(float(seen[0]), float(seen[-1])) if len(seen) else None,
        absent=() if group.absent is None else presence.intervals(times, group.absent),
    )


def _moves(quats: np.ndarray, path: np.ndarray, radius: float) -> bool:
    """Return True if the poses of a body differ from the last one by more than their errors."""
    turned = rotations.angle_between(quats, quats[-1]).max()
    return bool(turned > _TURN or np.linalg.norm(path - path[-1], axis=1).max() > _MOVE * radius)


def _center_of_mass(
    means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray, opacities: np.ndarray
) -> np.ndarray | None:
    """Return the centre of mass of an object's hull at uniform density, about which it turns in flight.

    Unlike a mean of Gaussians, it does not depend on their density, which follows the texture and what cameras see.
    Returns None if the object is nowhere solid.
    """
    if len(means) < 4:
        return None
    hull = silhouette_hull.of(means, quats, np.exp(log_scales.astype(np.float64)), opacities)
    try:
        return None if hull is None else solid.of(hull.vertices).center
    except ConfigError:  # a flat hull
        return None


def _middle(means: np.ndarray, opacities: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    """Return the opacity-weighted mean of a group's Gaussians, without the outer 5 % at both ends of each axis."""
    if len(means) < 3:
        return np.asarray(means.mean(0) if len(means) else fallback, np.float64)
    low, high = np.quantile(means, [0.05, 0.95], axis=0)
    inner = ((means >= low) & (means <= high)).all(1)
    if not inner.any():
        return np.median(means, axis=0)
    return np.average(means[inner], axis=0, weights=opacities[inner])
