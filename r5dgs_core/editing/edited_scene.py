"""Write edits made in Blender into a scene: remaining Gaussians, their new positions and motion.

Unedited parts keep the exact numbers of the file. Edited parts come from transforms sampled at the observed times and
after them (`edited_motion`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..playback import group_dynamics
from ..scene import slipped_rotations
from ..scene.lookup_table import LookupTable
from ..scene.scene import MotionGroup, Scene, SceneObject
from . import edited_gaussians, edited_motion, piece_clusters
from .edited_motion import MovedCluster
from .piece_clusters import Piece

__all__ = ("Piece", "edit")


def edit(
    scene: Scene, pieces: Sequence[Piece], times: np.ndarray, table: Mapping[int, SceneObject]
) -> tuple[Scene, list[str]]:
    """Apply edits to a scene.

    Args:
        scene: The original scene.
        pieces: Its remaining Gaussians, possibly repeated. Rows in no piece are deleted, and those that always are
            absent.
        times: The observed times and later ones, at which the ``matrices`` of the pieces are given. [T]
        table: Names, aliases, captions and colours by object id; its row ranges are ignored. Objects that are missing
            in the table keep theirs.

    Returns:
        The edited scene, and notes on losses, as sentences.

    Raises:
        ValueError: A piece exceeds the scene or has a singular matrix.
    """
    notes: list[str] = []
    pieces = [piece for piece in pieces if piece.count > 0]
    for piece in pieces:
        if not 0 <= piece.start <= piece.start + piece.count <= len(scene.gaussians.means):
            raise ValueError(f"{piece.name}: its rows exceed the scene's {len(scene.gaussians.means)} Gaussians")
    notes += [f"{piece.name}: left out, as it is hidden at all times" for piece in pieces if piece.is_never_there]
    pieces = [piece for piece in pieces if not piece.is_never_there]
    clusters = edited_motion.move(scene, piece_clusters.clusters(scene, pieces, notes), times, notes)
    kept, arrays, untouched = edited_gaussians.gather(scene, clusters)
    objects = _objects(scene, table, arrays["object_ids"])
    groups = _groups(clusters, scene, objects, kept, arrays["motion_ids"])
    same = untouched and all(cluster.same for cluster in clusters)
    if not same:
        for name in ("dynamics", "canonical_means"):
            if arrays.get(name) is not None:
                arrays[name] = None
                notes.append(f"'{name}' of individual Gaussians are valid only for the unedited scene and are omitted")
    by_object, lookup = _by_object(scene, objects, kept, arrays["object_ids"])
    result = replace(
        scene.with_arrays(
            **arrays,
            track_poses=np.stack([cluster.poses for cluster in clusters]),
            **by_object,
        ),
        objects=objects,
        groups=groups,
        lookup=lookup,
        hulls=scene.hulls if same and all(cluster.id == cluster.source.id for cluster in clusters) else (),
        provenance=slipped_rotations.renumbered(scene, [cluster.source.id for cluster in clusters]),
        needs=scene.needs if same else tuple(_without_simulation(row) for row in scene.needs),
    )
    return _with_representatives(result), notes


def _without_simulation(row: Mapping[str, Any]) -> dict[str, Any]:
    """Row of the needs table without the ground of a simulation, which is in world coordinates."""
    return {name: value for name, value in row.items() if name != "simulation"}


def _objects(scene: Scene, table: Mapping[int, SceneObject], object_ids: np.ndarray) -> tuple[SceneObject, ...]:
    """Objects of the new scene: those with Gaussians, those that were already empty, and the background."""
    old = {item.id: item for item in scene.objects}
    empty = {item.id for item in scene.objects if item.count == 0}
    wanted = sorted({0, *empty, *np.unique(object_ids).tolist()})
    result: list[SceneObject] = []
    names: set[str] = set()
    for object_id in wanted:
        item = table.get(object_id) or old.get(object_id)
        if item is None:
            item = SceneObject(object_id, f"object {object_id}", (), "", (0.5, 0.5, 0.5), 0, 0)
        name, number = item.name, 2
        while name in names:
            name, number = f"{item.name} {number}", number + 1
        names.add(name)
        start = int(np.searchsorted(object_ids, object_id))
        count = int(np.searchsorted(object_ids, object_id, side="right")) - start
        result.append(replace(item, id=object_id, name=name, start=start, count=count))
    return tuple(result)


def _groups(
    clusters: Sequence[MovedCluster],
    scene: Scene,
    objects: tuple[SceneObject, ...],
    kept: np.ndarray,
    motion_ids: np.ndarray,
) -> tuple[MotionGroup, ...]:
    """Motion groups with updated object ids and rows of representatives, -1 if a representative was deleted."""
    ids = {item.id for item in objects}
    new_ids = {cluster.source.id: cluster.id for cluster in reversed(clusters) if cluster.source.id or not cluster.id}
    groups = []
    for cluster in clusters:
        group = cluster.group
        rows = np.flatnonzero((kept == group.anchor_index) & (motion_ids == cluster.id))
        if cluster.id == 0 and not len(rows):
            rows = np.flatnonzero(kept == group.anchor_index)
        object_id = group.object_id
        if cluster.pieces and cluster.id and group.role == "body":
            own = [piece.object_id for piece in cluster.pieces]
            object_id = object_id if object_id in own else max(set(own), key=own.count)
        if not cluster.pieces and group.follows is not None:
            leader = new_ids.get(group.follows)
            group = replace(group, follows=leader, follow_matrix=None if leader is None else group.follow_matrix)
        if not cluster.pieces and group.parent is not None:
            group = replace(group, parent=new_ids.get(group.parent))
        groups.append(
            replace(
                group,
                id=cluster.id,
                object_id=object_id if object_id in ids else 0,
                anchor_index=int(rows[0]) if len(rows) else -1,
            )
        )
    return tuple(
        g if g.parent is not None and groups[g.parent].object_id == g.object_id else replace(g, parent=None, joint=None)
        for g in groups
    )


def _by_object(
    scene: Scene, objects: tuple[SceneObject, ...], kept: np.ndarray, object_ids: np.ndarray
) -> tuple[dict[str, np.ndarray], LookupTable | None]:
    """Rows of the classifier and the embeddings for the new objects; a new object inherits those of its source."""
    rows: dict[int, int] = {item.id: row for row, item in enumerate(scene.objects)}
    for item in objects:
        if item.id not in rows:
            source = int(scene.gaussians.object_ids[kept[item.start]]) if item.count else 0
            rows[item.id] = rows.get(source, rows[0])
    offset = sum(item.id < 0 for item in scene.objects)
    named = [rows[item.id] - offset for item in objects if item.id >= 0]
    mine, old = [rows[item.id] for item in objects], scene.arrays()
    chosen = {"classifier_weight": named, "classifier_bias": named, "embeddings": mine, "view_embeddings": mine}
    lookup = None if scene.lookup is None else scene.lookup.select(mine)
    return {name: old[name][at] for name, at in chosen.items() if name in old}, lookup


def _with_representatives(scene: Scene) -> Scene:
    """Choose a representative for each group that has lost its own."""
    groups = list(scene.groups)
    for number, group in enumerate(groups):
        rows = np.flatnonzero(scene.gaussians.motion_ids == number)
        if group.anchor_index < 0 and len(rows):
            groups[number] = replace(group, anchor_index=group_dynamics.representative(scene, rows))
    return replace(scene, groups=tuple(groups))
