"""Gaussians transformed by an affine map, with shapes, harmonics and shading applied.

The result can be drawn by renderers without support for rotation, tint or shading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..color import tints
from ..motion import rotations
from ..scene import diffuse_shading, spherical_harmonics
from ..scene.scene import Scene
from ..scene.splats import Splats
from . import posing
from .residuals import Residuals

SIMILARITY_TOLERANCE = 1e-5


@dataclass(frozen=True)
class Bend:
    """Deviation of Gaussians from the motion of their groups.

    Attributes:
        rows: Rows of the scene. [n]
        offsets: Added to their centres, bind frame. [n, 3]
        turns: Rotations applied to theirs, unit wxyz. [n, 4]
        growths: Added to their log scales. [n, 3]
    """

    rows: np.ndarray
    offsets: np.ndarray
    turns: np.ndarray
    growths: np.ndarray


def bend_of(residuals: Residuals, t: float, start: int, count: int) -> Bend | None:
    """Residuals of a range of Gaussians at a time, or None if there are none."""
    part = slice(*np.searchsorted(residuals.rows, (start, start + count)))
    found = residuals.at(t) if part.start < part.stop else None
    if found is None:
        return None
    offsets, turns, growths = (values[:, part].T for values in found)
    return Bend(residuals.rows[part], offsets, turns, growths)


def transform(splats: Splats, matrix: np.ndarray, factor: np.ndarray | None = None) -> Splats:
    """Transform Gaussians by an affine map.

    Rotation, translation, mirroring and uniform scale are exact. Under any other map the ellipsoids are still exact,
    and the harmonics are a least-squares fit over all directions (`spherical_harmonics.change_of_basis`).

    Args:
        splats: The Gaussians.
        matrix: Affine map. [4, 4]
        factor: Factor on their display-referred colour, >= 0, or None. [3], [N, 1] or [N, 3]

    Returns:
        New Gaussians; ids and identities are shared with the input.

    Raises:
        ValueError: The matrix is singular or not finite.
    """
    linear, offset = affine(matrix)
    means, quats, log_scales = (np.empty((len(splats.means), width), np.float32) for width in (3, 4, 3))
    posing.move_points(splats.means, linear, offset, means)
    map_shapes(linear, splats.quats, splats.log_scales, quats, log_scales)
    sh = spherical_harmonics.transform(splats.sh, linear)
    if factor is not None:
        sh = tints.tint_sh(sh, factor)
    return Splats(means, quats, log_scales, splats.opacity_logits, sh, splats.identities, splats.object_ids)


def place(
    scene: Scene,
    start: int,
    count: int,
    matrix: np.ndarray,
    *,
    world: np.ndarray | None = None,
    tint: np.ndarray | None = None,
    bend: Bend | None = None,
) -> Splats:
    """Transform a range of a scene's Gaussians from the bind state, with the shading of the resulting pose.

    Args:
        scene: The scene.
        start: First row.
        count: Number of rows.
        matrix: Affine map from the bind state to the target world. [4, 4]
        world: Map from the scene's own world, in which its light is fixed, to the target world; None if they are the
            same. Shading follows the nearest rotation of ``matrix`` relative to it. [4, 4]
        tint: Factor on the display-referred colour, or None. [3]
        bend: Deviations applied in the bind state before the map, or None.

    Raises:
        ValueError: The range exceeds the scene, or the matrix is singular or not finite.
    """
    if not 0 <= start <= start + count <= len(scene.gaussians.means):
        raise ValueError(f"rows {start}:{start + count} exceed the scene's {len(scene.gaussians.means)} Gaussians")
    rows, turn = slice(start, start + count), nearest_rotation(affine(matrix)[0])
    if world is not None:
        turn = nearest_rotation(affine(world)[0]).T @ turn
    splats, factor = bind_state(scene, rows), shading_factors(scene, rows, turn)
    if bend is not None:
        splats = _bent(scene, start, splats, bend)
        if factor is not None:
            turns = turn @ rotations.quats_to_rotmats(bend.turns)
            factor[bend.rows - start] = shading_factors(scene, bend.rows, turns)
    if tint is not None:
        factor = np.asarray(tint, np.float64) if factor is None else factor * np.asarray(tint, np.float64)
    return transform(splats, matrix, factor)


def bind_state(scene: Scene, rows: slice | np.ndarray) -> Splats:
    """Rows of a scene in the bind state, as stored in its file, without shading."""
    identities = scene.gaussians.identities
    return Splats(
        scene.gaussians.means[rows],
        scene.gaussians.quats[rows],
        scene.gaussians.log_scales[rows],
        scene.gaussians.opacity_logits[rows],
        scene.gaussians.sh[rows],
        None if identities is None else identities[rows].astype(np.float32),
        scene.gaussians.object_ids[rows],
    )


def _bent(scene: Scene, start: int, splats: Splats, bend: Bend) -> Splats:
    """Apply deviations to a range of the bind state that begins at ``start``."""
    at = bend.rows - start
    means, quats, log_scales = (values.copy() for values in (splats.means, splats.quats, splats.log_scales))
    means[at] += bend.offsets
    quats[at] = rotations.multiply(bend.turns, quats[at].astype(np.float64))
    log_scales[at] += bend.growths
    sh = splats.sh
    if scene.harmonics_turn and sh.shape[1] > 1:
        sh = sh.copy()
        sh[at] = spherical_harmonics.rotate(sh[at], bend.turns)
    return replace(splats, means=means, quats=quats, log_scales=log_scales, sh=sh)


def join(parts: Sequence[Splats]) -> Splats:
    """Concatenate sets of Gaussians. The degree is the highest one; missing coefficients are zero.

    Identities are kept if all parts have them in the same width, ids if all parts have them.
    """
    bases = max((part.sh.shape[1] for part in parts), default=1)
    sh = [np.pad(part.sh, ((0, 0), (0, bases - part.sh.shape[1]), (0, 0))) for part in parts]
    widths = {None if part.identities is None else part.identities.shape[1] for part in parts}
    kept = [part.identities for part in parts if part.identities is not None] if len(widths) == 1 else []
    ids = [part.object_ids for part in parts if part.object_ids is not None]
    return Splats(
        np.concatenate([np.empty((0, 3), np.float32), *(part.means for part in parts)]),
        np.concatenate([np.empty((0, 4), np.float32), *(part.quats for part in parts)]),
        np.concatenate([np.empty((0, 3), np.float32), *(part.log_scales for part in parts)]),
        np.concatenate([np.empty(0, np.float32), *(part.opacity_logits for part in parts)]),
        np.concatenate([np.empty((0, bases, 3), np.float32), *sh]),
        np.concatenate(kept) if kept else None,
        np.concatenate(ids) if parts and len(ids) == len(parts) else None,
    )


def affine(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Linear part and translation of an invertible [4, 4] matrix. Raises ValueError for any other matrix."""
    matrix = np.asarray(matrix, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"expected a finite matrix [4, 4], got {matrix!r}")
    singular = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if singular[-1] <= 1e-9 * max(singular[0], 1e-30):
        raise ValueError("the matrix is singular (scale 0)")
    return matrix[:3, :3], matrix[:3, 3]


def is_similarity(linear: np.ndarray) -> bool:
    """Return True if a linear map is a rotation or mirror with uniform scale. [3, 3]"""
    return _is_uniform(np.linalg.svd(linear, compute_uv=False))


def nearest_rotation(linear: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to a linear map. If the map mirrors, its first column changes sign beforehand.

    [..., 3, 3] -> [..., 3, 3]
    """
    mirror = np.where(np.linalg.det(linear) < 0, -1.0, 1.0)
    return rotations.nearest_rotmats(np.concatenate([linear[..., :1] * mirror[..., None, None], linear[..., 1:]], -1))


def _is_uniform(singular: np.ndarray) -> bool:
    return bool(singular[0] - singular[-1] <= SIMILARITY_TOLERANCE * singular[0])


def map_shapes(
    linear: np.ndarray,  # [3, 3]
    quats: np.ndarray,  # [N, 4]
    log_scales: np.ndarray,  # [N, 3]
    new_quats: np.ndarray,  # [N, 4]
    new_log_scales: np.ndarray,  # [N, 3]
) -> None:
    """Write the shapes of ellipsoids under any linear map, exactly, to the last two arguments, which are float32."""
    u, singular, vt = np.linalg.svd(linear)
    if _is_uniform(singular) and np.linalg.det(linear) > 0:
        posing.turn_quats(quats, rotations.rotmats_to_quats(u @ vt), new_quats)
        np.add(log_scales, np.float32(np.log(singular.mean())), out=new_log_scales)
        return
    axes = linear @ (rotations.quats_to_rotmats(np.asarray(quats, np.float64)) * np.exp(log_scales)[:, None, :])
    u, singular, _ = np.linalg.svd(axes)
    u[..., 2] *= np.sign(np.linalg.det(u))[:, None]
    new_quats[:], new_log_scales[:] = rotations.rotmats_to_quats(u), np.log(np.maximum(singular, 1e-30))


def shading_factors(scene: Scene, rows: slice | np.ndarray, rotation: np.ndarray) -> np.ndarray | None:
    """Colour factors of rows rotated since the bind state, or None without shading. [3, 3] or [n, 3, 3] -> [n, 1]"""
    if scene.shading is None:
        return None
    light = np.asarray(scene.shading.light, np.float64)
    change = diffuse_shading.light_change(light, rotation).astype(np.float32)
    rest = diffuse_shading.rest_factors(scene)[rows]
    return diffuse_shading.factors(rest, scene.shading.vectors[rows], change)[:, None]
