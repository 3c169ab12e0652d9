"""Consistency checks of a `Scene`: shapes, dtypes, finite numbers, unit quaternions, ranges, references.

Reading and writing apply the same checks.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from .. import errors, findings
from . import array_shapes, cameras, hull_json, model_checks, part_checks, presence
from .array_types import DTYPES, EMBEDDINGS
from .lookup_table import LookupTable
from .row_runs import runs
from .scene import GROUPS, ROLES, MotionGroup, Scene

_fail = array_shapes.fail
_UNIT_TOLERANCE = 1e-3

# Maximum numbers of a scene: their squares are within the range of float32, and no motion overflows within its times.
_LARGE = 1e9  # colours, logits, embeddings
_MAX_LOG_SCALE, _MIN_LOG_SCALE = 40.0, -1e4  # thinner Gaussians than float32 resolves are drawn at the minimum width
_RATES = np.repeat([cameras.FARTHEST, model_checks.SPIN, cameras.FARTHEST, model_checks.SPIN], 3)
_POSE = np.repeat([_LARGE, cameras.FARTHEST], [4, 3])
_LIMITS: dict[str, float | np.ndarray] = {
    "means": cameras.FARTHEST,
    "quats": _LARGE,
    "log_scales": _MAX_LOG_SCALE,
    "opacity_logits": _LARGE,
    "sh": _LARGE,
    "track_times": model_checks.MAX_TIME,
    "track_poses": _POSE,
    "background_sh": _LARGE,
    "identities": _LARGE,
    "classifier_weight": _LARGE,
    "classifier_bias": _LARGE,
    "residual_offsets": cameras.FARTHEST,
    "residual_quats": _LARGE,
    "residual_log_scales": _MAX_LOG_SCALE,
    "dynamics": _RATES,
    "canonical_means": cameras.FARTHEST,
    "shading": _LARGE,
    "shading_rest": _LARGE,
    "light_direction": _LARGE,
    "origin": cameras.FARTHEST,
}
_MAX_ID = np.iinfo(np.int32).max
_CONVERTED = ("background_sh", "identities", *EMBEDDINGS)  # any float dtype in memory; converted on writing
_DTYPES = {name: dtype for name, dtype in DTYPES.items() if name not in _CONVERTED} | {"origin": np.float64}


def check(scene: Scene, place: str, guard: findings.Guard = findings.STRICT) -> None:
    """Raise `SceneFileError` with ``place``, the member and the expected content if the scene is inconsistent.

    Args:
        scene: The scene; fields may be `findings.UNREAD` if the guard kept their errors.
        place: File, for messages.
        guard: Context manager entered around each array, rule, object, motion group and camera, for callers that
            collect all faults.
    """
    given = scene.arrays()
    for name, array in given.items():
        with guard():
            if not isinstance(array, np.ndarray) and array is not findings.UNREAD:
                _fail(place, name, "a numpy array", type(array).__name__)
    arrays = {name: array for name, array in given.items() if isinstance(array, np.ndarray)}
    shapes = {name: arrays[name].shape if name in arrays else findings.UNREAD for name in given}
    array_shapes.check(shapes, scene.objects, scene.groups, scene.vocabulary, scene.lookup, place, guard)
    for name, dtype in _DTYPES.items():
        with guard():
            if name in arrays and arrays[name].dtype != dtype:
                _fail(place, name, f"dtype {np.dtype(dtype)}", arrays[name].dtype)
    for name in _LIMITS:
        with guard():
            if name in arrays:
                check_range(name, arrays[name], place)
    check_embeddings({name: arrays.get(name) for name in EMBEDDINGS}, scene.lookup, place, guard)
    _check_groups(given, place, guard)
    for check_part in (_check_ids, _check_residuals, _check_units, _check_times, _check_objects):
        check_part(scene, place, guard)
    object_ids = findings.attempt(guard, lambda: {item.id for item in scene.objects})
    for row, group in enumerate(_listed(scene.groups)):
        if group is not findings.UNREAD:
            _check_group(scene, place, row, group, object_ids, guard)
    part_checks.check(scene, place, guard)
    hull_json.check(scene, place, guard)
    for camera in _listed(scene.cameras):
        with guard():
            try:
                if camera is not findings.UNREAD:
                    cameras.check(camera)
            except (TypeError, ValueError) as error:
                raise errors.SceneFileError(f"{place}: {error}") from error


def _listed(values: Sequence[Any]) -> Sequence[Any]:
    """Items of a field; empty if it could not be read."""
    return () if values is findings.UNREAD else values


def _check_groups(arrays: Mapping[str, Any], place: str, guard: findings.Guard) -> None:
    """Raise `SceneFileError` if an array is present without the others that its group requires."""
    for kind, names in GROUPS.values():
        required = [names[field.name] for field in dataclasses.fields(kind) if field.default is dataclasses.MISSING]
        present = next((name for name in names.values() if name in arrays), None)
        for name in required:
            with guard():
                if present is not None and name not in arrays:
                    _fail(place, name, f"an array beside {present!r}", "none")


def _check_ids(scene: Scene, place: str, guard: findings.Guard) -> None:
    with guard():
        groups = len(scene.groups)
        stray = scene.gaussians.motion_ids[(scene.gaussians.motion_ids < 0) | (scene.gaussians.motion_ids >= groups)]
        if len(stray):
            _fail(place, "motion_ids", f"ids of the {groups} motion groups", int(stray[0]))
    with guard():
        if len(scene.groups) == 0:
            _fail(place, "groups", "group 0, which is pinned", "none")
    with guard():
        if scene.world_convention not in cameras.WORLD_TO_BLENDER:
            _fail(place, "world_convention", f"one of {sorted(cameras.WORLD_TO_BLENDER)}", repr(scene.world_convention))


def check_embeddings(
    arrays: Mapping[str, np.ndarray | None],
    table: LookupTable | None,
    place: str,
    guard: findings.Guard = findings.STRICT,
) -> None:
    """Raise `SceneFileError` if numbers of stored embeddings or of their table are out of range.

    Args:
        arrays: `EMBEDDINGS` by name.
        table: Encoder, thresholds and views of the embeddings.
        place: File, for messages.
        guard: Context manager entered around each array and rule.
    """
    for name, array in arrays.items():
        with guard():
            if array is not None:
                _check_range(place, name, array, _LARGE)
    if table is None:
        return
    with guard():
        thresholds = [each for each in table.thresholds if each is not None]
        thresholds += [view.threshold for own in table.views for view in own]
        if not all(abs(each) <= _LARGE for each in (*thresholds, table.margin, table.encoder.scale)):
            _fail(place, "lookup", f"thresholds, margin and scale up to {_LARGE:g}", "others")
    with guard():
        if any("{}" not in template for template in table.encoder.templates):
            _fail(place, "lookup", "templates with '{}' for the phrase", table.encoder.templates)


def check_range(name: str, values: np.ndarray, place: str) -> None:
    """Raise `SceneFileError` if numbers of a field of `Scene` are not finite or out of range."""
    low = _MIN_LOG_SCALE if "log_scales" in name else None
    _check_range(place, name, values, _LIMITS[name], low)


def _check_range(
    place: str, name: str, values: np.ndarray, limit: float | np.ndarray, low: float | None = None
) -> None:
    """Raise `SceneFileError` for the first row with NaN or a number out of range.

    Args:
        place, name: For the message.
        values: Any shape.
        limit: Largest absolute value, for all or by column.
        low: Smallest value, or None for the negative limit.
    """
    least = -limit if low is None else low
    if not values.size or (values.min() >= np.max(least) and values.max() <= np.min(limit)):
        return
    bad = ~((values >= least) & (values <= limit))
    if bad.any():
        first = tuple(np.argwhere(bad)[0])
        most = np.broadcast_to(limit, values.shape)[first]
        _fail(place, name, f"finite numbers up to {most:g}", f"{values[first]:g} in row {first[0]}")


def _check_residuals(scene: Scene, place: str, guard: findings.Guard) -> None:
    if scene.residuals is None:
        return
    rows, count = scene.residuals.rows, len(scene.gaussians.means)
    with guard():
        bad = np.flatnonzero((rows < 0) | (rows >= count) | (np.diff(rows, prepend=-1) <= 0))
        if len(bad):
            _fail(place, "residual_rows", f"increasing rows below {count}", f"{rows[bad[0]]} at position {bad[0]}")
    for name in ("offsets", "log_scales"):
        with guard():
            last = getattr(scene.residuals, name)[:, -1]
            if (last != 0).any():
                wanted = "zero at t_max (residuals are relative to the bind state)"
                _fail(place, f"residual_{name}", wanted, f"{last[last != 0][0]:g}")


def _check_units(scene: Scene, place: str, guard: findings.Guard) -> None:
    arrays = scene.arrays()
    for name in ("quats", "track_poses", "residual_quats"):
        with guard():
            if name not in arrays:
                continue
            norms = np.linalg.norm(arrays[name][..., :4].reshape(-1, 4).astype(np.float64), axis=-1)
            off = np.flatnonzero(np.abs(norms - 1) > _UNIT_TOLERANCE)
            if len(off):
                _fail(place, name, "unit quaternions wxyz", f"norm {norms[off[0]]:.6g} in row {off[0]}")
    with guard():
        light = None if scene.shading is None else scene.shading.light
        if light is not None and abs(np.linalg.norm(light) - 1) > _UNIT_TOLERANCE:
            _fail(place, "light_direction", "a unit vector", light)


def _check_times(scene: Scene, place: str, guard: findings.Guard) -> None:
    times = scene.tracks.times
    with guard():
        if len(times) == 0 or not (np.diff(times) >= model_checks.MIN_STEP).all():
            _fail(place, "track_times", f"at least one time, increasing by {model_checks.MIN_STEP:g} or more", times)
    with guard():
        if not np.isfinite(scene.t_max) or times[-1] != scene.t_max:
            _fail(place, "t_max", f"the last of track_times, {float(times[-1])!r}", repr(scene.t_max))
    with guard():
        if not 1 / model_checks.MAX_TIME <= scene.frames_per_unit <= model_checks.MAX_TIME:
            _fail(place, "frames_per_unit", f"a positive number up to {model_checks.MAX_TIME:g}", scene.frames_per_unit)
    with guard():
        if not model_checks.MIN_LENGTH <= scene.near_plane <= cameras.FARTHEST:
            _fail(place, "near_plane", f"a positive depth up to {cameras.FARTHEST:g}", scene.near_plane)
    with guard(), np.errstate(invalid="ignore"):  # infinite means are reported separately
        last = scene.tracks.poses[:, -1]
        off = np.abs(np.abs(last) - np.array([1.0, 0, 0, 0, 0, 0, 0])).max(axis=-1) > 1e-9 * max(1.0, scene.extent)
        if off.any():
            row = int(np.flatnonzero(off)[0])
            wanted = "the identity at t_max (poses are relative to the bind state)"
            _fail(place, f"track_poses of group {row}", wanted, last[row])


def _check_objects(scene: Scene, place: str, guard: findings.Guard) -> None:
    with guard():
        ids = [item.id for item in scene.objects]
        if 0 not in ids or ids != sorted(set(ids)) or ids[0] < -1 or ids[-1] > _MAX_ID:
            _fail(place, "objects", f"increasing ids from -1 or 0 to {_MAX_ID}, with 0, the background", ids[:5])
    with guard():
        names = [item.name for item in scene.objects]
        if len(set(names)) != len(names):
            _fail(place, "objects", "unique names", f"{Counter(names).most_common(1)[0][0]!r} twice")
    _check_ranges(scene, place, guard)
    for item in _listed(scene.objects):
        with guard():
            if not all(0 <= channel <= 1 for channel in item.color):
                _fail(place, f"object {item.name!r}", "a color of numbers from 0 to 1", item.color)
        with guard():
            rows = scene.gaussians.motion_ids[item.start : item.start + item.count]
            if any(later[2] <= earlier[2] for earlier, later in pairwise(runs(rows))):
                _fail(place, f"motion_ids of object {item.name!r}", "increasing ids within the object", "another order")


def _check_ranges(scene: Scene, place: str, guard: findings.Guard) -> None:
    count = findings.attempt(guard, lambda: len(scene.gaussians.object_ids))
    position = findings.UNREAD if scene.objects is findings.UNREAD else 0
    for item in _listed(scene.objects):
        start, position = position, findings.UNREAD
        with guard():
            position = item.start + item.count
            if item.start != start or item.count < 0 or position > count:
                _fail(place, f"object {item.name!r}", f"a range that starts at {start}", f"{item.start} + {item.count}")
        with guard():
            rows = scene.gaussians.object_ids[item.start : item.start + item.count]
            if (rows != item.id).any():
                found = sorted(set(rows.tolist()))[:5]
                _fail(place, f"object {item.name!r}", f"object_ids {item.id} in its range", found)
    with guard():
        if position != count:
            _fail(place, "objects", f"ranges that cover {count} Gaussians", f"{position} covered")


def _check_group(
    scene: Scene, place: str, row: int, group: MotionGroup, object_ids: set[int], guard: findings.Guard
) -> None:
    where, farthest = f"motion group {row}", cameras.FARTHEST
    with guard():
        if group.id != row:
            _fail(place, where, f"id {row}", group.id)
    with guard():
        if group.role not in ROLES:
            _fail(place, where, f"one of the roles {', '.join(ROLES)}", repr(group.role))
    with guard():
        if group.object_id not in object_ids:
            _fail(place, where, "an object_id of the scene's objects", group.object_id)
    with guard():
        if not -1 <= group.anchor_index < len(scene.gaussians.means):
            _fail(place, where, f"an anchor_index below {len(scene.gaussians.means)}, or -1", group.anchor_index)
    with guard():
        if np.shape(group.pivot) != (3,) or not (np.abs(group.pivot) <= farthest).all():
            _fail(place, where, f"a pivot of three numbers up to {farthest:g}", group.pivot)
    with guard():
        if not (0 <= group.rigid_rms <= farthest and 0 <= group.rigid_max <= farthest):
            _fail(place, where, f"rigid residuals from 0 to {farthest:g}", (group.rigid_rms, group.rigid_max))
    model_checks.check(group.model, f"{place}: {where}: model", guard)
    if group.smooth is not None and group.smooth is not findings.UNREAD:
        model_checks.check(group.smooth, f"{place}: {where}: smooth model", guard)
    if group.joint is not None and group.joint is not findings.UNREAD:
        model_checks.check(group.joint.model, f"{place}: {where}: joint: model", guard)
    with guard():
        if group.seen is not None and not group.seen[0] <= group.seen[1]:
            _fail(place, where, "'seen' as first and last time, in order", group.seen)
    with guard():
        if not presence.are_sound(group.absent) or (row == 0 and group.absent):
            _fail(place, where, "'absent' as increasing times, none of group 0", group.absent)
    if row == 0:
        with guard():
            still = group.model.is_static and not (scene.tracks.poses[0] != scene.tracks.poses[0, -1]).any()
            if group.role != "pinned" or not still or group.follows is not None:
                _fail(place, where, "role 'pinned', a static model and no motion", repr(group.role))
    if group.follows is None or group.follows is findings.UNREAD:
        return
    with guard():
        known = 0 <= group.follows < len(scene.groups)
        leader = scene.groups[group.follows].follows if known else findings.UNREAD
        if not known or (leader is not None and leader is not findings.UNREAD):
            _fail(place, where, "a leader that follows no group", group.follows)
    with guard():
        matrix = group.follow_matrix
        if matrix is None or matrix.shape != (3, 3) or not (np.abs(matrix) <= _LARGE).all():
            _fail(place, where, f"a follow_matrix (3, 3) of numbers up to {_LARGE:g}", matrix)
