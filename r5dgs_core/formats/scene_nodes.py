"""Nodes of a scene in formats with a tree: pieces of Gaussians that move together, and names of motion groups."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

from .. import errors
from ..scene import row_runs
from ..scene.scene import Scene


class Piece(NamedTuple):
    """Gaussians of one object in one motion group: their rows, the id of the object, the group."""

    rows: slice
    object_id: int
    group: int


def pieces(scene: Scene, object_ids: Collection[int] | None) -> list[Piece]:
    """Pieces of the selected objects (all if None), in the order of the rows.

    Raises:
        ConfigError: No Gaussian is selected.
    """
    found = []
    for start, stop, object_id in row_runs.runs(scene.gaussians.object_ids):
        if object_ids is None or object_id in object_ids:
            within = row_runs.runs(scene.gaussians.motion_ids[start:stop])
            found += [Piece(slice(start + first, start + last), object_id, g) for first, last, g in within]
    if not found:
        raise errors.ConfigError(f"{scene.name}: expected Gaussians to export, found none in the selected objects")
    return found


def group_names(scene: Scene) -> list[str]:
    """Names of the motion groups: that of the object, with the number of the part if it has several bodies."""
    names = {item.id: item.name for item in scene.objects}
    bodies: dict[int, list[int]] = {item.id: [] for item in scene.objects}
    for group in scene.groups:
        if group.role == "body":
            bodies[group.object_id].append(group.id)
    found = []
    for group in scene.groups:
        name, own = names[group.object_id], bodies[group.object_id]
        if group.role == "pinned":
            found.append("static")
        elif group.role == "shadow":
            found.append(f"{name} (shadow)")
        else:
            found.append(name if len(own) < 2 else f"{name} (part {own.index(group.id) + 1})")
    return found
