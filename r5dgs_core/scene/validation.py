"""Whether a `Scene` is consistent: shapes, types, finite numbers, unit quaternions, ranges, references.

Reading and writing check the same rules, so what one accepts the other does too.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from .. import errors
from . import cameras
from .meanings import Table
from .playback import runs
from .scene import IDENTITY_DIM, ROLES, MotionGroup, Scene

SH_BASES = (1, 4, 9, 16)
EMBEDDINGS = ("embeddings", "vocabulary_embeddings", "canonical_embeddings", "view_embeddings")
_UNIT_TOLERANCE = 1e-3


def check(scene: Scene, place: str) -> None:
    """Raise `SceneFileError` naming ``place``, the member and what was expected where the scene is inconsistent."""
    count = len(scene.means)
    knots, groups = len(scene.track_times), len(scene.groups)
    classes = sum(item.id >= 0 for item in scene.objects)
    if scene.sh.ndim != 3 or scene.sh.shape[1] not in SH_BASES:
        _fail(place, "sh", f"({count}, K, 3) with K one of {SH_BASES}", scene.sh.shape)
    if scene.background_sh.ndim != 2 or scene.background_sh.shape[0] not in SH_BASES:
        _fail(place, "background_sh", f"(K, 3) with K one of {SH_BASES}", scene.background_sh.shape)
    strays = 0 if scene.residual_rows is None else len(scene.residual_rows)
    expected = {
        "means": ((count, 3), np.float32),
        "quats": ((count, 4), np.float32),
        "log_scales": ((count, 3), np.float32),
        "opacity_logits": ((count,), np.float32),
        "sh": ((count, scene.sh.shape[1], 3), np.float32),
        "object_ids": ((count,), np.int32),
        "motion_ids": ((count,), np.int32),
        "track_times": ((knots,), np.float64),
        "track_poses": ((groups, knots, 7), np.float64),
        "background_sh": ((scene.background_sh.shape[0], 3), None),
        "identities": ((count, IDENTITY_DIM), None),
        "classifier_weight": ((classes, IDENTITY_DIM), np.float32),
        "classifier_bias": ((classes,), np.float32),
        "residual_rows": ((strays,), np.int32),
        "residual_offsets": ((strays, knots, 3), np.float32),
        "residual_quats": ((strays, knots, 4), np.float32),
        "residual_log_scales": ((strays, knots, 3), np.float32),
        "dynamics": ((count, 12), np.float32),
        "canonical_means": ((count, 3), np.float32),
        "shading": ((count, 3), np.float32),
        "shading_rest": ((count,), np.float32),
        "light_direction": ((3,), None),
        "origin": ((3,), np.float64),
    }
    for name, (shape, dtype) in expected.items():
        array = getattr(scene, name)
        if array is None:
            continue
        if not isinstance(array, np.ndarray):
            _fail(place, name, "a numpy array", type(array).__name__)
        if array.shape != shape:
            _fail(place, name, f"shape {shape}", array.shape)
        if dtype is not None and array.dtype != dtype:
            _fail(place, name, f"dtype {np.dtype(dtype)}", array.dtype)
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            bad = int(np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(-1))[0])
            _fail(place, name, "finite numbers", f"NaN or infinity in row {bad}")
    stored = {name: getattr(scene, name) for name in EMBEDDINGS}
    check_meanings(stored, len(scene.objects), len(scene.vocabulary), scene.lookup, place)
    if (scene.classifier_weight is None) != (scene.classifier_bias is None):
        _fail(place, "classifier_weight", "'classifier_bias' beside it", "one without the other")
    stray = scene.motion_ids[(scene.motion_ids < 0) | (scene.motion_ids >= groups)]
    if len(stray):
        _fail(place, "motion_ids", f"ids of the {groups} motion groups", int(stray[0]))
    _check_residuals(scene, place)
    _check_units(scene, place)
    _check_times(scene, place)
    _check_objects(scene, place)
    for row, group in enumerate(scene.groups):
        _check_group(scene, place, row, group)
    if scene.world_convention not in cameras.WORLD_TO_BLENDER:
        _fail(place, "world_convention", f"one of {sorted(cameras.WORLD_TO_BLENDER)}", repr(scene.world_convention))
    for camera in scene.cameras:
        if camera.intrinsics.shape != (3, 3) or camera.T_cam_world.shape != (4, 4):
            _fail(place, f"camera {camera.name!r}", "intrinsics (3, 3) and T_cam_world (4, 4)", "other shapes")
        if not (np.isfinite(camera.intrinsics).all() and np.isfinite(camera.T_cam_world).all()):
            _fail(place, f"camera {camera.name!r}", "finite matrices", "NaN or infinity")
        rotation = camera.T_cam_world[:3, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > _UNIT_TOLERANCE or np.linalg.det(rotation) < 0:
            _fail(place, f"camera {camera.name!r}", "a rigid T_cam_world", "scale, shear or mirror")
        if camera.width < 1 or camera.height < 1:
            _fail(place, f"camera {camera.name!r}", "a positive size", f"{camera.width} x {camera.height}")


def check_meanings(
    arrays: dict[str, np.ndarray | None], objects: int, words: int, table: Table | None, place: str
) -> None:
    """Raise `SceneFileError` where stored embeddings do not fit each other, the objects or what is said about them.

    Args:
        arrays: `EMBEDDINGS` by name.
        objects: Rows of the table of objects.
        words: Words of the vocabulary.
        table: What is said about the embeddings.
        place: For messages.
    """
    lengths = {array.shape[-1] for array in arrays.values() if array is not None and array.ndim}
    if table is not None:
        lengths.add(table.encoder.dimension)
        absent = [name for name, array in arrays.items() if array is None]
        if absent:
            _fail(place, absent[0], "an array beside 'lookup'", "none")
    elif any(arrays[name] is not None for name in ("canonical_embeddings", "view_embeddings")):
        _fail(place, "lookup", "an entry beside 'canonical_embeddings' and 'view_embeddings'", "none")
    if len(lengths) > 1:
        _fail(place, "embeddings", "vectors of one length", sorted(lengths))
    canonical = 0 if table is None else len(table.canonical)
    views = arrays["view_embeddings"]
    most = 0 if views is None or views.ndim < 2 else views.shape[1]
    shapes = {
        "embeddings": (objects, None),
        "vocabulary_embeddings": (words, None),
        "canonical_embeddings": (canonical, None),
        "view_embeddings": (objects, most, None),
    }
    for name, shape in shapes.items():
        array = arrays[name]
        if array is None:
            continue
        if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
            _fail(place, name, f"shape {shape}", array.shape)
        if not np.isfinite(array).all():
            _fail(place, name, "finite numbers", "NaN or infinity")
    if table is None:
        return
    if len(table.views) != objects or any(len(own) > most for own in table.views):
        _fail(place, "lookup", f"{objects} objects of at most {most} views", [len(own) for own in table.views])
    thresholds = [each for each in table.thresholds if each is not None]
    thresholds += [view.threshold for own in table.views for view in own]
    if not all(np.isfinite(each) for each in (*thresholds, table.margin, table.encoder.scale)):
        _fail(place, "lookup", "finite thresholds, margin and scale", "others")
    if any("{}" not in template for template in table.encoder.templates):
        _fail(place, "lookup", "templates with '{}' for the phrase", table.encoder.templates)


def _fail(place: str, member: str, expected: str, found: object) -> None:
    raise errors.SceneFileError(f"{place}: {member}: expected {expected}, found {found}")


def _check_residuals(scene: Scene, place: str) -> None:
    rows = scene.residual_rows
    parts = (scene.residual_offsets, scene.residual_quats, scene.residual_log_scales)
    if any((part is None) != (rows is None) for part in parts):
        _fail(place, "residual_rows", "all four members residual_*, or none of them", "some of them")
    if scene.canonical_means is not None and scene.dynamics is None:
        _fail(place, "dynamics", "an array beside 'canonical_means'", "none")
    if rows is None or scene.residual_offsets is None or scene.residual_log_scales is None:
        return
    if len(rows) and (rows[0] < 0 or rows[-1] >= len(scene.means) or (np.diff(rows) <= 0).any()):
        _fail(place, "residual_rows", f"increasing rows below {len(scene.means)}", "others")
    for name in ("residual_offsets", "residual_log_scales"):
        if (getattr(scene, name)[:, -1] != 0).any():
            _fail(place, name, "zero at t_max (residuals are relative to the bind state)", "something else")


def _check_units(scene: Scene, place: str) -> None:
    turns = np.zeros((0, 4)) if scene.residual_quats is None else scene.residual_quats.reshape(-1, 4)
    poses = scene.track_poses[..., :4].reshape(-1, 4)
    for name, array in (("quats", scene.quats), ("track_poses", poses), ("residual_quats", turns)):
        norms = np.linalg.norm(array.astype(np.float64), axis=-1)
        off = np.flatnonzero(np.abs(norms - 1) > _UNIT_TOLERANCE)
        if len(off):
            _fail(place, name, "unit quaternions wxyz", f"norm {norms[off[0]]:.6g} in row {off[0]}")
    if scene.light_direction is not None and abs(np.linalg.norm(scene.light_direction) - 1) > _UNIT_TOLERANCE:
        _fail(place, "light_direction", "a unit vector", scene.light_direction)
    if scene.shading_rest is not None and scene.shading is None:
        _fail(place, "shading", "an array beside 'shading_rest'", "none")
    if scene.shading is not None and scene.light_direction is None:
        _fail(place, "light_direction", "a unit vector beside 'shading'", "none")


def _check_times(scene: Scene, place: str) -> None:
    times = scene.track_times
    if len(times) == 0 or not (np.diff(times) > 0).all():
        _fail(place, "track_times", "at least one time, strictly increasing", times)
    if not np.isfinite(scene.t_max) or times[-1] != scene.t_max:
        _fail(place, "t_max", f"the last of track_times, {times[-1]!r}", repr(scene.t_max))
    if not (np.isfinite(scene.frames_per_unit) and scene.frames_per_unit > 0):
        _fail(place, "frames_per_unit", "a positive number", scene.frames_per_unit)
    if not (np.isfinite(scene.near_plane) and scene.near_plane > 0):
        _fail(place, "near_plane", "a positive depth", scene.near_plane)
    last = scene.track_poses[:, -1]
    off = np.abs(np.abs(last) - np.array([1.0, 0, 0, 0, 0, 0, 0])).max(axis=-1) > 1e-9 * max(1.0, scene.extent)
    if off.any():
        g = int(np.flatnonzero(off)[0])
        _fail(
            place, f"track_poses of group {g}", "the identity at t_max (poses are relative to the bind state)", last[g]
        )


def _check_objects(scene: Scene, place: str) -> None:
    ids = [item.id for item in scene.objects]
    if 0 not in ids or ids != sorted(set(ids)) or min(ids, default=0) < -1:
        _fail(place, "objects", "increasing ids from -1 or 0 on, with 0, the background", ids)
    names = [item.name for item in scene.objects]
    if len(set(names)) != len(names):
        double = next(name for name in names if names.count(name) > 1)
        _fail(place, "objects", "unique names", f"{double!r} twice")
    position = 0
    for item in scene.objects:
        if item.start != position or item.count < 0 or item.start + item.count > len(scene.object_ids):
            _fail(place, f"object {item.name!r}", f"a range that starts at {position}", f"{item.start} + {item.count}")
        rows = scene.object_ids[item.start : item.start + item.count]
        if (rows != item.id).any():
            _fail(place, f"object {item.name!r}", f"object_ids {item.id} in its range", sorted(set(rows.tolist()))[:5])
        position += item.count
    if position != len(scene.object_ids):
        _fail(place, "objects", f"ranges that cover {len(scene.object_ids)} Gaussians", f"{position} covered")
    for item in scene.objects:
        rows = scene.motion_ids[item.start : item.start + item.count]
        if any(later[2] <= earlier[2] for earlier, later in pairwise(runs(rows))):
            _fail(place, f"motion_ids of object {item.name!r}", "increasing ids within the object", "another order")


def _check_group(scene: Scene, place: str, row: int, group: MotionGroup) -> None:
    where = f"motion group {row}"
    if group.id != row:
        _fail(place, where, f"id {row}", group.id)
    if group.role not in ROLES:
        _fail(place, where, f"a role out of {ROLES}", repr(group.role))
    if group.object_id not in {item.id for item in scene.objects}:
        _fail(place, where, "an object of the table", group.object_id)
    if not -1 <= group.anchor_index < len(scene.means):
        _fail(place, where, f"an anchor_index below {len(scene.means)}, or -1", group.anchor_index)
    if np.shape(group.pivot) != (3,) or not np.isfinite(group.pivot).all():
        _fail(place, where, "a pivot of three finite numbers", group.pivot)
    if not (np.isfinite(group.rigid_rms) and np.isfinite(group.rigid_max)):
        _fail(place, where, "finite rigid residuals", (group.rigid_rms, group.rigid_max))
    if group.seen is not None and not group.seen[0] <= group.seen[1]:
        _fail(place, where, "'seen' as first and last time, in order", group.seen)
    if row == 0:
        poses = scene.track_poses[0]
        if (
            group.role != "pinned"
            or not group.model.is_static
            or group.follows is not None
            or (poses != poses[-1]).any()
        ):
            _fail(place, where, "role 'pinned', a static model and no motion", repr(group.role))
    if group.follows is None:
        return
    if not 0 <= group.follows < len(scene.groups) or scene.groups[group.follows].follows is not None:
        _fail(place, where, "to follow a group that follows none", group.follows)
    matrix = group.follow_matrix
    if matrix is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        _fail(place, where, "a finite follow_matrix (3, 3)", group.follow_matrix)
