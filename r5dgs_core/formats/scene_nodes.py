"""Nodes of a scene in formats with a tree: pieces of Gaussians that move together, and names of motion groups."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .. import errors
from ..scene import predictability, presence, row_runs
from ..scene.scene import MotionGroup, Scene
from .registry import Options


class NodePiece(NamedTuple):
    """Gaussians of one object in one motion group: their rows, the id of the object, the group."""

    rows: slice
    object_id: int
    group: int


def check(scene: Scene, object_ids: Collection[int] | None) -> None:
    """Raise ConfigError if the selected objects (all if None) have no Gaussians."""
    if not any(item.count for item in scene.objects if object_ids is None or item.id in object_ids):
        raise errors.ConfigError(f"{scene.name}: expected Gaussians to export, found none in the selected objects")


def files(scene: Scene, options: Options, paths: Sequence[Path]) -> list[tuple[float, Path]]:
    """Return time and path of the files of single times, without those times at which all selected objects are absent.

    Args:
        scene: The scene.
        options: Selected objects and times.
        paths: File of each time.

    Raises:
        ConfigError: The selected objects have no Gaussians, or are absent at all of the times.
    """
    check(scene, options.object_ids)
    there = _are_there(scene, options)
    if any(there):
        return [found for found, shown in zip(zip(options.times, paths, strict=True), there, strict=True) if shown]
    first, last = min(options.times), max(options.times)
    when = f"at t = {first:g}" if first == last else f"from t = {first:g} to {last:g}"
    names = {item.id: item.name for item in scene.objects}
    told = [f"{names[group.object_id]} {presence.text(group.absent)}" for group in _groups(scene, options.object_ids)]
    known = "; ".join(list(dict.fromkeys(told))[:3])
    raise errors.ConfigError(f"{scene.name}: expected Gaussians {when}, but all selected objects are absent: {known}")


def lost_frames(scene: Scene, options: Options) -> list[str]:
    """Sentence about frames at which all selected objects are absent and that `files` leaves out, or none."""
    gone = [n for n, shown in zip(options.frames or (), _are_there(scene, options), strict=False) if not shown]
    if not gone:
        return []
    which = f"frame {gone[0]} is" if len(gone) == 1 else f"{len(gone)} frames from {gone[0]} to {gone[-1]} are"
    return [f"{which} not written, as all exported objects are absent then"]


def _are_there(scene: Scene, options: Options) -> list[bool]:
    """Return True for each time at which at least one selected object is there."""
    groups = _groups(scene, options.object_ids)
    return [not all(presence.is_absent(group.absent, t) for group in groups) for t in options.times]


def _groups(scene: Scene, object_ids: Collection[int] | None) -> list[MotionGroup]:
    """Motion groups of the Gaussians of the selected objects (all if None)."""
    return [scene.groups[k] for k in np.unique(scene.gaussians.motion_ids[selected(scene, object_ids)])]


def end(scene: Scene, options: Options) -> float:
    """Last scene time of a file with motion: `Options.until`, by default the horizon, and at least t_max."""
    return max(scene.t_max, predictability.horizon(scene) if options.until is None else options.until)


def pieces(scene: Scene, object_ids: Collection[int] | None) -> list[NodePiece]:
    """Pieces of the selected objects (all if None), in the order of the rows.

    Raises:
        ConfigError: No Gaussian is selected.
    """
    check(scene, object_ids)
    found = []
    for start, stop, object_id in row_runs.runs(scene.gaussians.object_ids):
        if object_ids is None or object_id in object_ids:
            within = row_runs.runs(scene.gaussians.motion_ids[start:stop])
            found += [NodePiece(slice(start + first, start + last), object_id, g) for first, last, g in within]
    return found


def group_names(scene: Scene) -> list[str]:
    """Names of the motion groups: that of the object, with the number of the part if it has several bodies."""
    names = {item.id: item.name for item in scene.objects}
    bodies = {item.id: [group.id for group in scene.bodies(item.id)] for item in scene.objects}
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


def selected(scene: Scene, object_ids: Collection[int] | None) -> np.ndarray:
    """Return a mask of the Gaussians of the selected objects, all if None. [N] bool"""
    found = scene.gaussians.object_ids
    return np.ones(len(found), bool) if object_ids is None else np.isin(found, list(object_ids))


def lost_bending(scene: Scene, object_ids: Collection[int] | None) -> list[str]:
    """Sentence about selected Gaussians that bend, for formats with rigid pieces; empty without them."""
    residuals = scene.residuals
    bend = np.zeros(0, bool) if residuals is None else selected(scene, object_ids)[residuals.rows]
    count = int(bend.sum())
    if residuals is None or not count:
        return []
    most = float(np.linalg.norm(residuals.offsets[bend], axis=-1).max()) / scene.extent
    return [f"{count} Gaussians bend, by up to {100 * most:.2g} % of the extent: as at t_max, they move rigidly"]
