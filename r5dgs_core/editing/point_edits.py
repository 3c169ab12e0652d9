"""Point-wise edits of Gaussians: moved, reshaped, recoloured, deleted or duplicated points.

An edit names a row of the scene for each point. `extend` appends the edited points to the scene, so that code for row
ranges of a scene handles them too.

An affine map that moves most points of an edit (Blender's *Apply Transform*, *Transform Geometry*) is detected by
comparing centres and returned with the points. Shapes, harmonics and shading then follow it, although the edit contains
only centres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..scene.scene import Scene
from ..scene.splats import to_opacities
from . import edited_gaussians

ROUNDING = 2e-6  # maximum residual of centres under a map, relative to the largest coordinate
MIN_POINTS = 5  # number of points that determine and confirm an affine map
TRIALS = 40  # number of RANSAC trials
SAMPLE = 4096  # number of points that each map is tested on
SAME = 1e-6  # relative tolerance of scales and opacities
_PER_POINT = (
    *("means", "quats", "log_scales", "opacity_logits", "sh", "shading"),
    *("identities", "motion_ids", "object_ids", "dynamics", "canonical_means"),
)
_RESIDUALS = ("residual_offsets", "residual_quats", "residual_log_scales")


@dataclass(frozen=True)
class PointEdit:
    """Points of one cloud after an edit. Values are in the bind frame; None keeps those of the scene.

    Attributes:
        rows: Row of each point in the scene; rows may repeat. [n] integers
        means: Centres. [n, 3]
        quats: Rotations wxyz, of any non-zero length. [n, 4]
        scales: Standard deviations. [n, 3]
        base: Harmonics of degree 0, and opacity in [0, 1]. [n, 4]
        sh: The first K harmonics of higher degree. [n, K, 3]
    """

    rows: np.ndarray
    means: np.ndarray | None = None
    quats: np.ndarray | None = None
    scales: np.ndarray | None = None
    base: np.ndarray | None = None
    sh: np.ndarray | None = None


@dataclass(frozen=True)
class Place:
    """Rows of an extended scene with the points of an edit, and the map to their final positions.

    Attributes:
        start: First row.
        count: Number of rows.
        matrix: Affine map in the bind frame. [4, 4]
    """

    start: int
    count: int
    matrix: np.ndarray


def extend(scene: Scene, edits: Sequence[PointEdit]) -> tuple[Scene, list[Place]]:
    """Append edited points to a scene.

    Args:
        scene: The scene; not modified.
        edits: The edits.

    Returns:
        The scene with the edited points appended, and the place of each edit. Object ids of the result are not sorted.

    Raises:
        ValueError: A row is not in the scene, or an array has the wrong shape or contains values that are not finite.
    """
    places, parts, filled = [], [], len(scene.gaussians.means)
    for edit in edits:
        part, place = apply(scene, edit)
        if part is not scene:
            parts.append(part)
            place = replace(place, start=filled)
            filled += place.count
        places.append(place)
    return (_appended(scene, parts) if parts else scene), places


def apply(scene: Scene, edit: PointEdit) -> tuple[Scene, Place]:
    """Return a scene with the points of one edit, and their place in it.

    If the edit only transforms consecutive rows by an affine map, the scene itself is returned.

    Raises:
        ValueError: As `extend`.
    """
    _check(scene, edit)
    rows = np.asarray(edit.rows, np.int64)
    matrix, part = _edited(scene, rows, edit)
    if part is None and _consecutive(rows):
        return scene, Place(int(rows[0]), len(rows), matrix)
    return _selected(scene, rows) if part is None else part, Place(0, len(rows), matrix)


def affine_between(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the affine map that moves at least half of the points, exactly up to float32 rounding.

    Directions without extent are mapped like the normal of a surface.

    Args:
        before: Points. [n, 3]
        after: The same points after the map. [n, 3]

    Returns:
        The map [4, 4] and a mask of the points that it moves [n]; None if there is no such invertible map.
    """
    if len(before) < MIN_POINTS:
        return None
    a, b = before.astype(np.float64), after.astype(np.float64)
    still = (a == b).all(-1)
    if 2 * still.sum() >= len(a):
        return np.eye(4), still
    allowed = ROUNDING * max(np.abs(a).max(), np.abs(b).max(), 1e-30)
    random = np.random.default_rng(0)
    some = np.arange(len(a)) if len(a) <= SAMPLE else random.choice(len(a), SAMPLE, replace=False)
    best = _fit(a[some], b[some])
    count = _explained(best, a[some], b[some], allowed).sum()
    for _ in range(TRIALS):
        if 2 * count >= len(some):
            break
        chosen = random.choice(some, MIN_POINTS, replace=False)
        tried = _fit(a[chosen], b[chosen])
        found = _explained(tried, a[some], b[some], allowed).sum()
        best, count = (tried, found) if found > count else (best, count)
    inside = _explained(best, a, b, allowed)
    for _ in range(3):  # refine, because a map through few points is imprecise
        if inside.sum() < MIN_POINTS:
            return None
        best = _fit(a[inside], b[inside])
        inside = _explained(best, a, b, allowed)
    singular = np.linalg.svd(best[:3, :3], compute_uv=False)
    if 2 * inside.sum() < len(a) or not singular[2] > 1e-4 * singular[0]:
        return None
    return best, inside


def _fit(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Least-squares affine map between two sets of points. [4, 4]"""
    center, target = a.mean(0), b.mean(0)
    u, singular, vt = np.linalg.svd(a - center, full_matrices=False)
    flat = singular <= 1e-5 * singular[0]
    with np.errstate(divide="ignore"):
        inverse = np.where(flat, 0.0, 1.0 / singular)
    linear = ((b - target).T @ u) * inverse @ vt
    if flat.sum() == 1:
        axes = linear @ vt[:2].T
        normal = np.cross(axes[:, 0], axes[:, 1]) * np.linalg.det(vt)
        linear += np.outer(normal / max(np.sqrt(np.linalg.norm(normal)), 1e-30), vt[2])
    elif flat.any():  # the rotation of a line or a point is undetermined
        linear += (vt[flat].T @ vt[flat]) if flat.all() else np.full((3, 3), np.nan)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, target - linear @ center
    return matrix


def _explained(matrix: np.ndarray, a: np.ndarray, b: np.ndarray, allowed: float) -> np.ndarray:
    return np.abs(a @ matrix[:3, :3].T + matrix[:3, 3] - b).max(-1) <= allowed


def _check(scene: Scene, edit: PointEdit) -> None:
    rows = np.asarray(edit.rows)
    if rows.ndim != 1 or len(rows) and not (rows.min() >= 0 and rows.max() < len(scene.gaussians.means)):
        raise ValueError(f"points: expected rows of the scene's {len(scene.gaussians.means)} Gaussians")
    for name, shape in (("means", (3,)), ("quats", (4,)), ("scales", (3,)), ("base", (4,)), ("sh", (-1, 3))):
        values = getattr(edit, name)
        if values is None:
            continue
        wanted = (len(rows), *(size if size >= 0 else values.shape[1] for size in shape))
        if values.shape != wanted or not np.isfinite(values).all():
            raise ValueError(f"points: expected finite '{name}' of shape {wanted}, found {values.shape}")


def _edited(scene: Scene, rows: np.ndarray, edit: PointEdit) -> tuple[np.ndarray, Scene | None]:
    """Map of an edit, and its points before that map, or None if they equal those of the scene."""
    part = _selected(scene, rows)
    shapes = _given_shapes(part, edit)
    looks = _given_looks(part, edit)
    matrix, means = np.eye(4), edit.means
    if means is not None and (means == part.gaussians.means).all():
        means = None
    if means is not None and not shapes:
        matrix, moved = _unmoved(part, rows, means)
        part, means = (part, None) if moved is None else (moved, None)
        changed = moved is not None
    else:
        changed = means is not None
    if means is not None:
        part = part.with_arrays(means=np.ascontiguousarray(means, np.float32))
    if shapes or changed:  # the learned motion of single points belongs to the old centres
        part = replace(part, dynamics=None)
    return matrix, part.with_arrays(**shapes, **looks) if shapes or looks or changed else None


def _given_shapes(part: Scene, edit: PointEdit) -> dict[str, np.ndarray]:
    """Rotations and log scales that differ from those of ``part``."""
    found = {}
    if edit.quats is not None and not (edit.quats == part.gaussians.quats).all():
        length = np.linalg.norm(edit.quats, axis=-1, keepdims=True)
        unit = np.where(length > 0, edit.quats / np.where(length > 0, length, 1), part.gaussians.quats)
        found["quats"] = unit.astype(np.float32)
    if edit.scales is not None:
        same = np.isclose(edit.scales, np.exp(part.gaussians.log_scales), rtol=SAME, atol=0)
        if not same.all():
            given = np.log(np.maximum(edit.scales, 1e-30))
            found["log_scales"] = np.where(same, part.gaussians.log_scales, given).astype(np.float32)
    return found


def _given_looks(part: Scene, edit: PointEdit) -> dict[str, np.ndarray]:
    """Harmonics and opacities that differ from those of ``part``."""
    found = {}
    if edit.base is not None:
        opacity = edit.base[:, 3].astype(np.float64)
        own = to_opacities(part.gaussians.opacity_logits)
        same = np.isclose(opacity, own, rtol=SAME, atol=1e-7)
        if not same.all():
            opacity = np.clip(opacity, 1e-7, 1 - 1e-7)
            given = np.log(opacity / (1 - opacity))
            found["opacity_logits"] = np.where(same, part.gaussians.opacity_logits, given).astype(np.float32)
        if not (edit.base[:, :3] == part.gaussians.sh[:, 0]).all():
            found["sh"] = part.gaussians.sh.copy()
            found["sh"][:, 0] = edit.base[:, :3]
    if edit.sh is not None:
        bases = slice(1, min(1 + edit.sh.shape[1], part.gaussians.sh.shape[1]))
        given = edit.sh[:, : bases.stop - 1]
        if not (given == part.gaussians.sh[:, bases]).all():
            found.setdefault("sh", part.gaussians.sh.copy())[:, bases] = given
    return found


def _unmoved(part: Scene, rows: np.ndarray, means: np.ndarray) -> tuple[np.ndarray, Scene | None]:
    """Factor the map of most points out of an edit of centres.

    Copies of the same rows may have different maps; that of the first copy is factored out of all.

    Args:
        part: The points as in the scene. [n]
        rows: Their rows. [n]
        means: The new centres. [n, 3]

    Returns:
        The map [4, 4], and the points before it; None if the map moves all points.
    """
    copies = _copy_numbers(rows)
    matrix, result, changed = np.eye(4), part, False
    for copy in range(copies.max(initial=-1) + 1):
        chosen = np.flatnonzero(copies == copy)
        found = affine_between(part.gaussians.means[chosen], means[chosen])
        own, inside = (np.eye(4), np.zeros(len(chosen), bool)) if found is None else found
        if copy == 0:
            matrix, own = own, np.eye(4)
        else:
            own = np.linalg.solve(matrix, own)
        if not np.allclose(own, np.eye(4), rtol=0, atol=1e-12):
            result, changed = _moved(result, chosen, own), True
        outside = chosen[~inside]
        if not len(outside):
            continue
        back = np.linalg.inv(matrix)
        still = outside[(means[outside] == part.gaussians.means[outside]).all(-1)]
        if len(still) and found is not None:  # their shapes stay in place too
            result = _moved(result, still, back)
        new = result.gaussians.means.copy()
        new[outside] = means[outside] @ back[:3, :3].T + back[:3, 3]
        result, changed = result.with_arrays(means=new), True
    return matrix, result if changed else None


def _copy_numbers(rows: np.ndarray) -> np.ndarray:
    """Number of earlier occurrences of each row. [n]"""
    order = np.argsort(rows, kind="stable")
    ordered = rows[order]
    starts = np.flatnonzero(np.diff(ordered, prepend=-1))
    result = np.empty(len(rows), np.int64)
    result[order] = np.arange(len(rows)) - np.repeat(starts, np.diff(starts, append=len(rows)))
    return result


def _moved(part: Scene, chosen: np.ndarray, matrix: np.ndarray) -> Scene:
    """Transform some points by an affine map. chosen [k]"""
    old, arrays = part.arrays(), {}
    for name, values in edited_gaussians.transformed_rows(part, chosen, matrix).items():
        whole = old[name].copy() if name in old else np.ones(len(part.gaussians.means), np.float32)
        whole[chosen] = values
        arrays[name] = whole
    if part.residuals is not None:
        at = np.isin(part.residuals.rows, chosen)
        offsets, quats = part.residuals.offsets.copy(), part.residuals.quats.copy()
        offsets[at], quats[at] = edited_gaussians.rotated_residuals(offsets[at], quats[at], matrix[:3, :3])
        arrays |= {"residual_offsets": offsets, "residual_quats": quats}
    return part.with_arrays(**arrays)


def _consecutive(rows: np.ndarray) -> bool:
    return len(rows) > 0 and bool((np.diff(rows) == 1).all())


def _selected(scene: Scene, rows: np.ndarray) -> Scene:
    """Scene of the given rows of another, which may repeat."""
    old = scene.arrays()
    chosen = slice(rows[0], rows[0] + len(rows)) if _consecutive(rows) else rows  # a slice does not copy
    arrays = {name: old[name][chosen] for name in (*_PER_POINT, "shading_rest") if name in old}
    if scene.residuals is not None:
        known = scene.residuals.rows
        place = np.minimum(np.searchsorted(known, rows), max(len(known) - 1, 0))
        bending = np.flatnonzero(known[place] == rows) if len(known) else rows[:0]
        arrays["residual_rows"] = bending.astype(np.int32)
        for name in _RESIDUALS:
            arrays[name] = old[name][place[bending]]
    return scene.with_arrays(**arrays)


def _appended(scene: Scene, parts: Sequence[Scene]) -> Scene:
    """Scene with the points of ``parts`` appended."""
    every: list[dict[str, np.ndarray]] = [one.arrays() for one in (scene, *parts)]
    arrays: dict[str, np.ndarray | None] = {}
    for name in _PER_POINT:
        whole = all(name in one for one in every)
        arrays[name] = np.concatenate([one[name] for one in every]) if whole else None
    if any("shading_rest" in one for one in every):
        rests = [one.get("shading_rest", np.ones(len(one["means"]), np.float32)) for one in every]
        arrays["shading_rest"] = np.concatenate(rests)
    if scene.residuals is not None:
        starts = np.cumsum([0, *(len(one["means"]) for one in every)])
        shifted = (one["residual_rows"] + start for one, start in zip(every, starts, strict=False))
        arrays["residual_rows"] = np.concatenate(list(shifted)).astype(np.int32)
        for name in _RESIDUALS:
            arrays[name] = np.concatenate([one[name] for one in every])
    return scene.with_arrays(**arrays)
