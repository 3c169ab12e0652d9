"""Gaussians of an edited scene: rows of the file in a new order, some of them transformed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..color import tints
from ..motion import rotations
from ..playback import affine_transform
from ..scene import diffuse_shading
from ..scene.scene import Scene
from .piece_clusters import Cluster

TOLERANCE = 1e-5  # minimum displacement that counts, relative to the scene's extent


def gather(scene: Scene, clusters: Sequence[Cluster]) -> tuple[np.ndarray, dict[str, Any], bool]:
    """Collect the Gaussians of the edited scene from the file's.

    Args:
        scene: The original scene.
        clusters: Remaining Gaussians by motion group.

    Returns:
        Rows of the file in the new order, the arrays of the new scene, and True if all Gaussians stayed in place.
    """
    ordered = [(piece.object_id, cluster.id, piece.start, piece) for cluster in clusters for piece in cluster.pieces]
    ordered.sort(key=lambda entry: entry[:3])
    last, kept, untouched = len(scene.tracks.times) - 1, [], True
    old = scene.arrays()
    names = ("means", "quats", "log_scales", "sh", "shading", "shading_rest")
    columns = {name: [old[name][:0]] for name in names if name in old}
    if scene.shading is not None:
        columns.setdefault("shading_rest", [np.empty(0, np.float32)])
    residuals: list[tuple[np.ndarray, ...]] = []
    object_ids, motion_ids, filled = [], [], 0
    for object_id, motion_id, start, piece in ordered:
        rows = slice(start, start + piece.count)
        bind = np.asarray(piece.matrices[last], np.float64)
        moved = _displacement(scene, rows, bind) > TOLERANCE * scene.extent
        untouched &= not moved
        values = transformed_rows(scene, rows, bind if moved else None)
        if piece.tint is not None:
            values["sh"] = tints.tint_sh(values["sh"], piece.tint)
        for name, parts in columns.items():
            parts.append(values[name])
        residuals.append(_residuals(scene, rows, filled - start, affine_transform.affine(bind)[0] if moved else None))
        kept.append(np.arange(rows.start, rows.stop))
        object_ids.append(np.full(piece.count, object_id, np.int32))
        motion_ids.append(np.full(piece.count, motion_id, np.int32))
        filled += piece.count
    order = np.concatenate([np.empty(0, np.int64), *kept])
    arrays: dict[str, Any] = {name: np.concatenate(parts) for name, parts in columns.items()}
    if scene.shading is not None and scene.shading.rest is None and (arrays["shading_rest"] == 1).all():
        del arrays["shading_rest"]
    for name in ("opacity_logits", "identities", "dynamics", "canonical_means"):
        if name in old:
            arrays[name] = old[name][order]
    arrays["object_ids"] = np.concatenate([np.empty(0, np.int32), *object_ids])
    arrays["motion_ids"] = np.concatenate([np.empty(0, np.int32), *motion_ids])
    if scene.residuals is not None:
        members = ("residual_rows", "residual_offsets", "residual_quats", "residual_log_scales")
        for number, name in enumerate(members):
            parts = (part[number] for part in residuals)
            arrays[name] = np.concatenate([old[name][:0], *parts]).astype(old[name].dtype)
    return order, arrays, untouched


def _displacement(scene: Scene, rows: slice, bind: np.ndarray) -> float:
    """Upper bound of the displacement of Gaussians under a map, including rotation and scaling of their extent."""
    linear = bind[:3, :3] - np.eye(3)
    means = scene.gaussians.means[rows].astype(np.float64)
    size = float(np.exp(scene.gaussians.log_scales[rows].max()))
    moved = np.linalg.norm(means @ linear.T + bind[:3, 3], axis=-1).max()
    return float(moved + size * np.linalg.norm(linear))


def transformed_rows(scene: Scene, rows: slice | np.ndarray, bind: np.ndarray | None) -> dict[str, np.ndarray]:
    """Arrays of rows transformed by an affine map of the bind state.

    Args:
        scene: The scene.
        rows: The rows. [n]
        bind: The map, or None to keep the arrays unchanged. [4, 4]

    Returns:
        ``means quats log_scales sh``, and ``shading shading_rest`` if the scene has shading. [n, ...] each
    """
    shading = None if scene.shading is None else scene.shading.vectors[rows]
    rest = diffuse_shading.rest_factors(scene)[rows]
    splats = affine_transform.bind_state(scene, rows)
    if bind is not None:
        splats = affine_transform.transform(splats, bind)
        if scene.shading is not None:
            turn = affine_transform.nearest_rotation(bind[:3, :3])
            light = np.asarray(scene.shading.light, np.float64)
            rest = (rest + scene.shading.vectors[rows] @ diffuse_shading.light_change(light, turn)).astype(np.float32)
            shading = (scene.shading.vectors[rows] @ turn.T).astype(np.float32)
    values = {"means": splats.means, "quats": splats.quats, "log_scales": splats.log_scales, "sh": splats.sh}
    if shading is not None:
        values |= {"shading": shading, "shading_rest": rest}
    return values


def _residuals(scene: Scene, rows: slice, shift: int, linear: np.ndarray | None) -> tuple[np.ndarray, ...]:
    """Residuals of rows of the file, rotated with the bind state: new rows, offsets, rotations, growths."""
    if scene.residuals is None:
        return ()
    found = scene.residuals
    inside = (found.rows >= rows.start) & (found.rows < rows.stop)
    offsets, quats = found.offsets[inside], found.quats[inside]
    if linear is not None:
        offsets, quats = rotated_residuals(offsets, quats, linear)
    return found.rows[inside] + shift, offsets, quats, found.log_scales[inside]


def rotated_residuals(
    offsets: np.ndarray,  # [n, S, 3]
    quats: np.ndarray,  # [n, S, 4]
    linear: np.ndarray,  # [3, 3]
) -> tuple[np.ndarray, np.ndarray]:
    """Offsets and rotations of residuals after a linear map of the bind state. Shapes as given."""
    turn = rotations.rotmats_to_quats(affine_transform.nearest_rotation(linear))
    turned = rotations.multiply(rotations.multiply(turn, quats.astype(np.float64)), rotations.conjugate(turn))
    return offsets @ linear.T, turned
