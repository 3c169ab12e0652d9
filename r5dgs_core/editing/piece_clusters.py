"""Pieces of an edited scene, grouped by their motion.

Notation: M(t) is the map from the file's bind state to the file's world as shown by Blender, B = M(t_max) the map to
the new bind state, and P(t) = M(t) B^-1 the motion since then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..motion import rotations
from ..motion.models import MotionModel
from ..playback import affine_transform
from ..scene.scene import MotionGroup, Scene

RIGID_TOLERANCE = 1e-3  # allowed deviation of the linear part of a motion from a rotation


@dataclass(frozen=True)
class Piece:
    """Gaussians of one object and one motion group after editing.

    Attributes:
        name: Name for messages.
        object_id: Object that they belong to.
        motion_id: Their motion group in the file.
        start: First row in the file.
        count: Number of rows.
        mover: Key of the object that moves them; pieces with equal mover, group and absence stay together.
        matrices: Maps from the bind state of the file to its world, at the observed times and later ones. [T, 4, 4]
        pivot: Centre of rotation at t_max; None for the transformed pivot of the group. [3]
        parent: Linear part of the parent transform of their whole learned motion, or None. [3, 3]
        model: Their motion past t_max before ``parent``, or None for the file's.
        allowed: Position tolerance, world units.
        tint: Factor on their display-referred colour, or None. [3]
        absent: True at times at which they are not in the scene; None for the times of the file. [T] bool
    """

    name: str
    object_id: int
    motion_id: int
    start: int
    count: int
    mover: str
    matrices: np.ndarray
    pivot: np.ndarray | None = None
    parent: np.ndarray | None = None
    model: MotionModel | None = None
    allowed: float = 0.0
    tint: np.ndarray | None = None
    absent: np.ndarray | None = None

    @property
    def is_never_there(self) -> bool:
        """True if they are absent at all times."""
        return self.absent is not None and bool(self.absent.all())

    @property
    def presence(self) -> list[bool] | None:
        """Times at which they are not in the scene, comparable between pieces."""
        return None if self.absent is None else self.absent.tolist()


@dataclass(frozen=True)
class PieceMotion:
    """A rigid motion relative to t_max, sampled at T times.

    Attributes:
        quats: Unit wxyz. [T, 4]
        linears: The linear parts, which are rotations if the motion is rigid. [T, 3, 3]
        shifts: The translations. [T, 3]
    """

    quats: np.ndarray
    linears: np.ndarray
    shifts: np.ndarray

    def moves(self, pivot: np.ndarray) -> np.ndarray:
        """Displacements of a pivot given at t_max. [3] -> [T, 3]"""
        return self.linears @ pivot + self.shifts - pivot

    @property
    def bent(self) -> float:
        """Largest deviation of the linear parts from rotations; 0 for a rigid motion."""
        return float(np.abs(self.linears - rotations.quats_to_rotmats(self.quats)).max(initial=0.0))


@dataclass(frozen=True)
class Cluster:
    """Pieces with a common motion and absence, which form a new motion group.

    Attributes:
        pieces: Its members; empty for a group that was already empty.
        source: Their group in the file.
        motion: Motion shown by Blender.
        id: Id of the new group.
    """

    pieces: list[Piece]
    source: MotionGroup
    motion: PieceMotion
    id: int = 0

    @property
    def first(self) -> Piece:
        """Largest member, which represents the cluster."""
        return max(self.pieces, key=lambda piece: piece.count)


def clusters(scene: Scene, pieces: Sequence[Piece], notes: list[str]) -> list[Cluster]:
    """Groups of the new scene in order: the pinned one, those of the file, then those with a new motion.

    Args:
        scene: The original scene.
        pieces: Its remaining Gaussians.
        notes: List to which losses are appended.
    """
    last = len(scene.tracks.times) - 1
    pinned = scene.groups[0]
    still = PieceMotion(rotations.identity(1), np.eye(3)[None], np.zeros((1, 3)))
    found: list[Cluster] = [Cluster([], pinned, still)]
    for piece in pieces:
        source = scene.groups[piece.motion_id] if 0 < piece.motion_id < len(scene.groups) else pinned
        motion = _since_bind(np.asarray(piece.matrices, np.float64), last)
        if motion.bent > RIGID_TOLERANCE:
            notes.append(f"{piece.name}: its scale changes with time, which a scene file cannot hold")
        radius = reach(scene, piece, np.zeros(3))
        keyed = piece.absent is not None and bool(piece.absent.any())  # group 0 is always there
        if source is pinned and not keyed and (_apart(motion, still, radius) <= piece.allowed).all():
            found[0].pieces.append(piece)
            continue
        for cluster in found[1:]:
            first = cluster.pieces[0]
            alike = cluster.source is source and first.mover == piece.mover and first.presence == piece.presence
            if alike and (_apart(motion, cluster.motion, radius) <= piece.allowed).all():
                cluster.pieces.append(piece)
                break
        else:
            found.append(Cluster([piece], source, motion))
    used = {cluster.source.id for cluster in found}
    members = set(np.unique(scene.gaussians.motion_ids).tolist())
    for group in scene.groups[1:]:  # groups that were already empty are kept
        if group.id not in used and group.id not in members:
            found.append(Cluster([], group, still))
    firsts: set[int] = set()

    def order(cluster: Cluster) -> tuple[bool, int]:
        again = cluster.source.id in firsts or (cluster.source is pinned and cluster is not found[0])
        firsts.add(cluster.source.id)
        return (again, cluster.source.id)

    found = [cluster for _, cluster in sorted(((order(c), c) for c in found), key=lambda entry: entry[0])]
    return [replace(cluster, id=number) for number, cluster in enumerate(found)]


def _since_bind(matrices: np.ndarray, bind: int) -> PieceMotion:
    """Motion P of the maps M, given the index of t_max. [T, 4, 4]"""
    maps = matrices @ np.linalg.inv(matrices[bind])
    quats = rotations.rotmats_to_quats(affine_transform.nearest_rotation(maps[:, :3, :3]))
    quats[bind] = (1.0, 0, 0, 0)
    maps[bind] = np.eye(4)
    return PieceMotion(quats, maps[:, :3, :3], maps[:, :3, 3])


def _apart(motion: PieceMotion, other: PieceMotion, reach: float) -> np.ndarray:
    """Upper bound of the distance between two motions of points within ``reach`` of the origin. [T]"""
    turned = np.linalg.norm(motion.linears - other.linears, axis=(-2, -1))
    return np.linalg.norm(motion.shifts - other.shifts, axis=-1) + reach * turned


def reach(scene: Scene, piece: Piece, point: np.ndarray) -> float:
    """Largest distance of a piece's Gaussians from a point in the new bind state. [3]"""
    bind = piece.matrices[len(scene.tracks.times) - 1]
    means = scene.gaussians.means[piece.start : piece.start + piece.count].astype(np.float64)
    return float(np.linalg.norm(means @ bind[:3, :3].T + bind[:3, 3] - point, axis=-1).max())
