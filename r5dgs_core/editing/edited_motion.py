"""Motion groups of an edited scene: the track up to t_max and the motion model after it.

Notation: M(t) is the map from the file's bind state to the file's world as shown by Blender, B = M(t_max) the map to
the new bind state, and P(t) = M(t) B^-1 the motion since then. A parent that transforms a whole learned motion P0 by a
similarity X gives P = X P0 X^-1. P0 then comes from the file, which is more precise than Blender's samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..motion import fit_drawn_curve, models, rotations
from ..motion.models import MotionModel
from ..playback import affine_transform, group_dynamics
from ..scene import presence
from ..scene.scene import MotionGroup, Scene
from . import piece_clusters
from .piece_clusters import Cluster, PieceMotion


@dataclass(frozen=True, kw_only=True)
class MovedCluster(Cluster):
    """A cluster with its new motion group.

    Attributes:
        group: The new group.
        poses: Its poses at the observed times. [S, 7]
        same: True if it moves as in the file.
    """

    group: MotionGroup
    poses: np.ndarray
    same: bool


@dataclass(frozen=True)
class _Course:
    """Motion of a cluster in the observed time.

    Attributes:
        poses: Poses of the new group. [S, 7]
        pivot: Its pivot at t_max. [3]
        parent: Linear part of the parent transform of the whole learned motion. [3, 3]
        reach: Largest distance of a member from the pivot.
        allowed: Position tolerance, world units.
        same: True if the motion is as in the file.
    """

    poses: np.ndarray
    pivot: np.ndarray
    parent: np.ndarray
    reach: float = 0.0
    allowed: float = 0.0
    same: bool = True


def _turned(quats: np.ndarray, moves: np.ndarray, parent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses X P0 X^-1 of a motion under a parent that is a similarity. [T, 4], [T, 3] and X [3, 3]"""
    if (parent == np.eye(3)).all():
        return quats, moves
    turn = rotations.rotmats_to_quats(_turn_of(parent)[0])
    return rotations.multiply(rotations.multiply(turn, quats), rotations.conjugate(turn)), moves @ parent.T


def _turn_of(parent: np.ndarray) -> tuple[np.ndarray, float]:
    """Rotation R and signed scale s of a similarity s R; s is negative for a mirror.

    Positions transform by both, rotation axes by R only. [3, 3] -> [3, 3] and s
    """
    scale = float(np.cbrt(np.linalg.det(parent)))
    return affine_transform.nearest_rotation(np.sign(scale) * parent), scale


def _turned_model(model: MotionModel, parent: np.ndarray) -> MotionModel:
    """Transform a motion model as `_turned` does."""
    return model if (parent == np.eye(3)).all() else model.transformed(*_turn_of(parent))


def _track(
    sampled: PieceMotion, pivot: np.ndarray, known: np.ndarray, reach: float, allowed: float
) -> tuple[np.ndarray, bool]:
    """Poses of a group at the knots, relative to the new bind state.

    Args:
        sampled: Motion shown by Blender, at the S knots and later.
        pivot: Pivot of the group at t_max. [3]
        known: Transformed poses of the file, used if Blender shows the same. [S, 7]
        reach: Largest distance of a member from the pivot.
        allowed: Position tolerance, world units.

    Returns:
        The poses [S, 7], and True if they are the known ones.
    """
    quats, moves = sampled.quats[: len(known)], sampled.moves(pivot)[: len(known)]
    if (fit_drawn_curve.pose_errors(known[:, :4], known[:, 4:], quats, moves, reach) <= allowed).all():
        return known, True
    poses = np.concatenate([rotations.make_continuous(quats[::-1])[::-1], moves], axis=-1)
    poses[-1] = (1.0, 0, 0, 0, 0, 0, 0)
    return poses, False


def move(scene: Scene, found: Sequence[Cluster], times: np.ndarray, notes: list[str]) -> list[MovedCluster]:
    """Determine track and model of every cluster.

    Args:
        scene: The original scene.
        found: Result of `piece_clusters.clusters`.
        times: The observed times and later ones. [T]
        notes: List to which losses are appended.

    Returns:
        The clusters in the same order.
    """
    quats, moves = group_dynamics.knot_poses(scene)
    known = np.concatenate([quats, moves], axis=-1)
    carried = {group.id: number for number, (group, _) in enumerate(group_dynamics.parts_of(scene.groups), start=1)}
    courses = [_course(scene, cluster, known) for cluster in found]
    later = np.asarray(times[len(scene.tracks.times) :], np.float64) - scene.t_max
    groups: dict[int, tuple[MotionGroup, bool]] = {}

    def turn(
        cluster: Cluster,
    ) -> tuple[bool, int]:  # parts come after their parents, and groups that follow another last
        return cluster.source.follows is not None, carried.get(cluster.source.id, 0)

    for cluster in sorted(found, key=turn):
        if cluster.id == 0 or not cluster.pieces:
            groups[cluster.id] = replace(cluster.source, id=cluster.id), True
            continue
        leaders = [
            (courses[other.id], *groups[other.id])
            for other in found[1:]
            if other.source.id in (cluster.source.follows, cluster.source.parent) and other.id in groups
        ]
        groups[cluster.id] = _go_on(scene, cluster, courses[cluster.id], leaders, later, notes)
    return [
        MovedCluster(
            cluster.pieces,
            cluster.source,
            cluster.motion,
            cluster.id,
            group=replace(groups[cluster.id][0], absent=_absent(cluster, times)),
            poses=course.poses,
            same=groups[cluster.id][1],
        )
        for cluster, course in zip(found, courses, strict=True)
    ]


def _absent(cluster: Cluster, times: np.ndarray) -> tuple[presence.Interval, ...]:
    """Intervals at which the new group of a cluster is absent: those of the file if they hide it at the same times."""
    known = cluster.source.absent
    given = cluster.first.absent if cluster.pieces else None
    if cluster.id == 0 or given is None or given.tolist() == [presence.is_absent(known, t) for t in times]:
        return known
    return presence.intervals(times, given)


def _course(scene: Scene, cluster: Cluster, known: np.ndarray) -> _Course:
    """Motion of a cluster up to t_max, with the file's own poses [G, S, 7] if Blender shows the same."""
    source, count = cluster.source, len(scene.tracks.times)
    if not cluster.pieces or cluster.id == 0:
        return _Course(scene.tracks.poses[source.id], np.asarray(source.pivot, np.float64), np.eye(3))
    first = cluster.first
    allowed = max(piece.allowed for piece in cluster.pieces)
    parent = np.eye(3) if first.parent is None else first.parent
    pivot = _pivot(scene, cluster, allowed)
    reach = max(1e-9 * scene.extent, *(piece_clusters.reach(scene, piece, pivot) for piece in cluster.pieces))
    if source.id == 0:
        before = np.tile([1.0, 0, 0, 0, 0, 0, 0], (count, 1))
    else:
        before = np.concatenate(_turned(known[source.id, :, :4], known[source.id, :, 4:], parent), axis=-1)
    poses, observed = _track(cluster.motion, pivot, before, reach, allowed)
    if observed and (before == known[source.id]).all() and source.id:
        poses = scene.tracks.poses[source.id].copy()  # signs included
    return _Course(poses, pivot, parent, reach, allowed, observed and bool((parent == np.eye(3)).all()))


def _pivot(scene: Scene, cluster: Cluster, allowed: float) -> np.ndarray:
    """Pivot at t_max, exactly the file's if it is the same within the tolerance."""
    first = cluster.first
    own = np.asarray(cluster.source.pivot, np.float64)
    bind = first.matrices[len(scene.tracks.times) - 1]
    if cluster.source.id == 0:
        own = np.median(scene.gaussians.means[first.start : first.start + first.count].astype(np.float64), axis=0)
    pivot = bind[:3, :3] @ own + bind[:3, 3] if first.pivot is None else np.asarray(first.pivot, np.float64)
    home = bind[:3, :3] @ cluster.source.home + bind[:3, 3]  # a part's anchor is at its joint
    if cluster.source.joint is not None and np.linalg.norm(pivot - home) <= allowed:
        pivot = bind[:3, :3] @ own + bind[:3, 3]
    return own if np.linalg.norm(pivot - own) <= allowed else pivot


def _go_on(
    scene: Scene,
    cluster: Cluster,
    course: _Course,
    leaders: Sequence[tuple[_Course, MotionGroup, bool]],
    later: np.ndarray,
    notes: list[str],
) -> tuple[MotionGroup, bool]:
    """Build the new group of a cluster.

    It keeps the given or the file's motion model if Blender shows the same motion past t_max; else a model is fitted.

    Args:
        scene: The original scene.
        cluster: The cluster.
        course: Its motion in the observed time.
        leaders: New versions of the group that its own follows: course, group, True if its motion is unchanged.
        later: Times since t_max. [L]
        notes: List to which losses are appended.

    Returns:
        The group, and True if it moves as in the file, before and after t_max.
    """
    source, first = cluster.source, cluster.first
    rows = slice(len(scene.tracks.times), None)
    quats, moves = cluster.motion.quats[rows], cluster.motion.moves(course.pivot)[rows]
    known = _known_fields(cluster, course)

    def shown(q: np.ndarray, d: np.ndarray) -> bool:
        return bool((fit_drawn_curve.pose_errors(q, d, quats, moves, course.reach) <= course.allowed).all())

    if source.joint is not None:
        quats_of, moves_of = _played(scene, source.id, later)
        if shown(*_turned(quats_of, moves_of, course.parent)):
            for leading, parent, _ in leaders:
                if (carried := _carried(scene, source, course, leading, parent)) is not None:
                    return replace(carried, **known), course.same and carried.joint is source.joint
        notes.append(f"{first.name}: its joint is left out, as its motion or that of its parent was edited")
        source = replace(source, parent=None, joint=None)
    if source.follows is not None and source.follow_matrix is not None:
        for leading, leader, as_before in leaders:
            matrix = course.parent @ source.follow_matrix @ np.linalg.inv(leading.parent)
            _, led = models.evaluate(leader.model, later)
            if shown(rotations.identity(len(later)), led @ matrix.T):
                return replace(source, **known, follows=leader.id, follow_matrix=matrix), course.same and as_before
    else:
        given = [] if first.model is None else [first.model]
        for model in (*given, source.model):
            turned = _turned_model(model, course.parent)
            if shown(*models.evaluate(turned, later)):
                known |= _kept_fields(source, model, course)
                return replace(source, **known, model=turned), course.same and turned == source.model
    model, error = fit_drawn_curve.fit(later, quats, moves, course.reach, course.allowed)
    if error > 10 * course.allowed:
        miss = f"the nearest one deviates by up to {error:.3g}"
        notes.append(f"{first.name}: no motion model matches its curves past t_max; {miss}")
    history = replace(source.history, band=None, errors=None)
    known |= {"smooth": None, "history": history}
    return replace(source, **known, model=model, follows=None, follow_matrix=None), False


def _known_fields(cluster: Cluster, course: _Course) -> dict[str, Any]:
    """Fields of the new group that do not depend on its motion past t_max."""
    source = cluster.source
    scale = float(abs(np.linalg.det(course.parent)) ** (1 / 3))
    known = {"pivot": course.pivot, "id": cluster.id, "seen": source.seen}
    known |= {"rigid_rms": scale * source.rigid_rms, "rigid_max": scale * source.rigid_max}
    if source.id == 0:
        known |= {"role": "body", "object_id": cluster.first.object_id, "rigid_rms": 0.0, "rigid_max": 0.0}
    return known


def _kept_fields(source: MotionGroup, model: MotionModel, course: _Course) -> dict[str, Any]:
    """History of a group that goes on with a known model, and its smooth motion if that is the file's."""
    band = source.history if model is source.model else replace(source.history, band=None)
    history = band if (course.parent == np.eye(3)).all() else band.transformed(*_turn_of(course.parent))
    smooth = source.smooth if model == source.model else None
    return {
        "history": history if course.same else replace(history, errors=None),
        "smooth": None if smooth is None else _turned_model(smooth, course.parent),
    }


def _played(scene: Scene, group: int, later: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses of a group at times since t_max, as in playback. [L, 4], [L, 3]"""
    motion = group_dynamics.GroupMotion(scene)
    poses = [motion.poses(scene.t_max + float(tau)) for tau in later]
    quats, moves = ([pose[part][group] for pose in poses] for part in (0, 1))
    return np.reshape(quats, (-1, 4)), np.reshape(moves, (-1, 3))


def _carried(
    scene: Scene, source: MotionGroup, course: _Course, leading: _Course, parent: MotionGroup
) -> MotionGroup | None:
    """Return a part with its joint, or None if a similarity does not place both it and its parent.

    Args:
        scene: The original scene.
        source: The part in it.
        course: New motion of the part in the observed time.
        leading: New motion of its parent in the observed time.
        parent: New group of its parent.
    """
    assert source.parent is not None and source.joint is not None
    old, linear = scene.groups[source.parent], course.parent
    shift = course.pivot - linear @ source.pivot
    together = np.linalg.norm(leading.pivot - linear @ old.pivot - shift) <= course.allowed
    alike = together and np.abs(leading.parent - linear).max() <= 1e-6
    if not alike or parent.model != _turned_model(old.model, leading.parent):
        return None
    if (linear == np.eye(3)).all():
        moved = source if not shift.any() else replace(source, joint=source.joint.transformed(np.eye(3), 1.0, shift))
        return replace(moved, parent=parent.id)
    turn, scale = _turn_of(linear)
    history = replace(source.history.transformed(turn, scale), errors=None)
    joint = source.joint.transformed(turn, scale, shift)
    return replace(source, model=source.model.transformed(turn, scale), history=history, joint=joint, parent=parent.id)
