"""Checks that a `Scene` is consistent: shapes, types, finite numbers, unit quaternions, ranges, references.

Reading and writing apply the same rules.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from .. import errors, findings
from ..motion.models import MotionModel
from . import cameras
from .meanings import Table
from .playback import runs
from .scene import IDENTITY_DIM, ROLES, MotionGroup, Scene, SceneObject

SH_BASES = (1, 4, 9, 16)
EMBEDDINGS = ("embeddings", "vocabulary_embeddings", "canonical_embeddings", "view_embeddings")
_UNIT_TOLERANCE = 1e-3

# Largest numbers that a scene may hold: single precision can square them, and no motion overflows within its times.
_LARGE = 1e9  # colours, logits, embeddings
_LOG_SCALE, _LEAST_LOG_SCALE = 40.0, -1e4  # what is thinner than single precision is drawn as thin as can be
_SPIN = 1e6  # rad per unit of time, and per its square
_LEAST_LENGTH = 1e-30  # of the near plane and of radii
_LEAST_STEP, _MOST_TIME = 1e-12, 1e12  # between observed times
_RATES = np.repeat([cameras.FARTHEST, _SPIN, cameras.FARTHEST, _SPIN], 3)
_POSE = np.repeat([_LARGE, cameras.FARTHEST], [4, 3])
_LIMITS: dict[str, float | np.ndarray] = {
    "means": cameras.FARTHEST,
    "quats": _LARGE,
    "log_scales": _LOG_SCALE,
    "opacity_logits": _LARGE,
    "sh": _LARGE,
    "track_times": _MOST_TIME,
    "track_poses": _POSE,
    "background_sh": _LARGE,
    "identities": _LARGE,
    "classifier_weight": _LARGE,
    "classifier_bias": _LARGE,
    "residual_offsets": cameras.FARTHEST,
    "residual_quats": _LARGE,
    "residual_log_scales": _LOG_SCALE,
    "dynamics": _RATES,
    "canonical_means": cameras.FARTHEST,
    "shading": _LARGE,
    "shading_rest": _LARGE,
    "light_direction": _LARGE,
    "origin": cameras.FARTHEST,
}
_MODEL_LIMITS = {
    "velocity": cameras.FARTHEST,
    "acceleration": cameras.FARTHEST,
    "angular_velocity": _SPIN,
    "angular_acceleration": _SPIN,
    "center_offset": cameras.FARTHEST,
    "offset_rotvec": _SPIN,
    "offset_displacement": cameras.FARTHEST,
    "fade_time": _MOST_TIME,
    "radius": cameras.FARTHEST,
    "frequency": _SPIN,
}
_MOST_ID = np.iinfo(np.int32).max
_DTYPES = {
    "means": np.float32,
    "quats": np.float32,
    "log_scales": np.float32,
    "opacity_logits": np.float32,
    "sh": np.float32,
    "object_ids": np.int32,
    "motion_ids": np.int32,
    "track_times": np.float64,
    "track_poses": np.float64,
    "background_sh": None,
    "identities": None,
    "classifier_weight": np.float32,
    "classifier_bias": np.float32,
    "residual_rows": np.int32,
    "residual_offsets": np.float32,
    "residual_quats": np.float32,
    "residual_log_scales": np.float32,
    "dynamics": np.float32,
    "canonical_means": np.float32,
    "shading": np.float32,
    "shading_rest": np.float32,
    "light_direction": None,
    "origin": np.float64,
}


def check(scene: Scene, place: str, guard: findings.Guard = findings.STRICT) -> None:
    """Raise `SceneFileError` with ``place``, the member and the expected content if the scene is inconsistent.

    Args:
        scene: The scene.
        place: For messages.
        guard: Entered around each array, object, motion group and camera, for callers that want all faults.
    """
    for name in (*_DTYPES, *EMBEDDINGS):
        array = getattr(scene, name)
        if array is not None and not isinstance(array, np.ndarray):
            _fail(place, name, "a numpy array", type(array).__name__)
    arrays = {name: array for name in (*_DTYPES, *EMBEDDINGS) if (array := getattr(scene, name)) is not None}
    shapes = {name: array.shape for name, array in arrays.items()}
    check_shapes(shapes, scene.objects, scene.groups, scene.vocabulary, scene.lookup, place)
    for name, dtype in _DTYPES.items():
        if name in arrays and dtype is not None and arrays[name].dtype != dtype:
            _fail(place, name, f"dtype {np.dtype(dtype)}", arrays[name].dtype)
    for name in _LIMITS:
        with guard():
            if name in arrays:
                check_range(name, arrays[name], place)
    with guard():
        check_meanings({name: getattr(scene, name) for name in EMBEDDINGS}, scene.lookup, place)
    with guard():
        _check_ids(scene, place)
    for rule in (_check_residuals, _check_units, _check_times):
        with guard():
            rule(scene, place)
    _check_objects(scene, place, guard)
    object_ids = {item.id for item in scene.objects}
    for row, group in enumerate(scene.groups):
        with guard():
            _check_group(scene, place, row, group, object_ids)
    for camera in scene.cameras:
        with guard():
            try:
                cameras.check(camera)
            except (TypeError, ValueError) as error:
                raise errors.SceneFileError(f"{place}: {error}") from error


def _check_ids(scene: Scene, place: str) -> None:
    if (scene.classifier_weight is None) != (scene.classifier_bias is None):
        _fail(place, "classifier_weight", "'classifier_bias' beside it", "one without the other")
    groups = len(scene.groups)
    stray = scene.motion_ids[(scene.motion_ids < 0) | (scene.motion_ids >= groups)]
    if len(stray):
        _fail(place, "motion_ids", f"ids of the {groups} motion groups", int(stray[0]))
    if not scene.groups:
        _fail(place, "groups", "group 0, which is pinned", "none")
    if scene.world_convention not in cameras.WORLD_TO_BLENDER:
        _fail(place, "world_convention", f"one of {sorted(cameras.WORLD_TO_BLENDER)}", repr(scene.world_convention))


def check_shapes(
    shapes: Mapping[str, tuple[int, ...]],
    objects: Sequence[SceneObject],
    groups: Sequence[MotionGroup],
    vocabulary: Sequence[str],
    table: Table | None,
    place: str,
) -> None:
    """Raise `SceneFileError` if the shapes of a scene's arrays do not fit each other or the rest of the scene.

    Args:
        shapes: Shapes by name, at least of the arrays that every scene has.
        objects, groups, vocabulary, table: Fields of `Scene`, the last one `Scene.lookup`.
        place: For messages.
    """
    count, knots, strays = (_length(shapes, name) for name in ("means", "track_times", "residual_rows"))
    classes = sum(item.id >= 0 for item in objects)
    for name in ("sh", "background_sh"):
        rank = 3 if name == "sh" else 2
        if len(shapes[name]) != rank or shapes[name][-2] not in SH_BASES:
            wanted = f"({count}, K, 3)" if name == "sh" else "(K, 3)"
            _fail(place, name, f"{wanted} with K one of {SH_BASES}", shapes[name])
    expected = {
        "means": (count, 3),
        "quats": (count, 4),
        "log_scales": (count, 3),
        "opacity_logits": (count,),
        "sh": (count, shapes["sh"][1], 3),
        "object_ids": (count,),
        "motion_ids": (count,),
        "track_times": (knots,),
        "track_poses": (len(groups), knots, 7),
        "background_sh": (shapes["background_sh"][0], 3),
        "identities": (count, IDENTITY_DIM),
        "classifier_weight": (classes, IDENTITY_DIM),
        "classifier_bias": (classes,),
        "residual_rows": (strays,),
        "residual_offsets": (strays, knots, 3),
        "residual_quats": (strays, knots, 4),
        "residual_log_scales": (strays, knots, 3),
        "dynamics": (count, 12),
        "canonical_means": (count, 3),
        "shading": (count, 3),
        "shading_rest": (count,),
        "light_direction": (3,),
        "origin": (3,),
    }
    for name, shape in expected.items():
        if shapes.get(name, shape) != shape:
            _fail(place, name, f"shape {shape}", shapes[name])
    check_meaning_shapes(shapes, len(objects), len(vocabulary), table, place)


def check_meaning_shapes(
    shapes: Mapping[str, tuple[int, ...]], objects: int, words: int, table: Table | None, place: str
) -> None:
    """Raise `SceneFileError` if the shapes of stored embeddings do not fit each other or their table.

    Args:
        shapes: Shapes by name; only `EMBEDDINGS` are checked.
        objects: Rows of the table of objects.
        words: Words of the vocabulary.
        table: Encoder, thresholds and views of the embeddings.
        place: For messages.
    """
    there = {name: shapes[name] for name in EMBEDDINGS if name in shapes}
    lengths = {shape[-1] for shape in there.values() if shape}
    if table is not None:
        lengths.add(table.encoder.dimension)
        absent = [name for name in EMBEDDINGS if name not in there]
        if absent:
            _fail(place, absent[0], "an array beside 'lookup'", "none")
    elif "canonical_embeddings" in there or "view_embeddings" in there:
        _fail(place, "lookup", "an entry beside 'canonical_embeddings' and 'view_embeddings'", "none")
    if len(lengths) > 1:
        _fail(place, "embeddings", "vectors of one length", sorted(lengths))
    views = there.get("view_embeddings", ())
    most = views[1] if len(views) > 1 else 0
    expected = {
        "embeddings": (objects, None),
        "vocabulary_embeddings": (words, None),
        "canonical_embeddings": (0 if table is None else len(table.canonical), None),
        "view_embeddings": (objects, most, None),
    }
    for name, shape in there.items():
        wanted = expected[name]
        if len(shape) != len(wanted) or any(n is not None and n != m for n, m in zip(wanted, shape, strict=True)):
            _fail(place, name, f"shape {wanted}", shape)
    if table is not None and (len(table.views) != objects or any(len(own) > most for own in table.views)):
        _fail(place, "lookup", f"{objects} objects of at most {most} views", [len(own) for own in table.views][:5])


def check_meanings(arrays: Mapping[str, np.ndarray | None], table: Table | None, place: str) -> None:
    """Raise `SceneFileError` if numbers of stored embeddings or of their table are out of range.

    Args:
        arrays: `EMBEDDINGS` by name.
        table: Encoder, thresholds and views of the embeddings.
        place: For messages.
    """
    for name, array in arrays.items():
        if array is not None:
            _check_range(place, name, array, _LARGE)
    if table is None:
        return
    thresholds = [each for each in table.thresholds if each is not None]
    thresholds += [view.threshold for own in table.views for view in own]
    if not all(abs(each) <= _LARGE for each in (*thresholds, table.margin, table.encoder.scale)):
        _fail(place, "lookup", f"thresholds, margin and scale up to {_LARGE:g}", "others")
    if any("{}" not in template for template in table.encoder.templates):
        _fail(place, "lookup", "templates with '{}' for the phrase", table.encoder.templates)


def _length(shapes: Mapping[str, tuple[int, ...]], name: str) -> int:
    """Rows of an array; 0 without it."""
    return next(iter(shapes.get(name, ())), 0)


def check_range(name: str, values: np.ndarray, place: str) -> None:
    """Raise `SceneFileError` if numbers of a field of `Scene` are not finite or out of range."""
    low = _LEAST_LOG_SCALE if "log_scales" in name else None
    _check_range(place, name, values, _LIMITS[name], low)


def _check_range(
    place: str, name: str, values: np.ndarray, limit: float | np.ndarray, low: float | None = None
) -> None:
    """Raise `SceneFileError` with the first row that holds NaN or a number out of range.

    Args:
        place, name: For the message.
        values: Any shape.
        limit: Largest absolute value, of all or of each column.
        low: Smallest value; the negative limit if None.
    """
    least = -limit if low is None else low
    if not values.size or (values.min() >= np.max(least) and values.max() <= np.min(limit)):
        return
    bad = ~((values >= least) & (values <= limit))
    if bad.any():
        first = tuple(np.argwhere(bad)[0])
        most = np.broadcast_to(limit, values.shape)[first]
        _fail(place, name, f"finite numbers up to {most:g}", f"{values[first]:g} in row {first[0]}")


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
    if len(rows) and (rows[0] < 0 or rows[-1] >= len(scene.means) or (rows[1:] <= rows[:-1]).any()):
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
    if len(times) == 0 or not (np.diff(times) >= _LEAST_STEP).all():
        _fail(place, "track_times", f"at least one time, increasing by {_LEAST_STEP:g} or more", times)
    if not np.isfinite(scene.t_max) or times[-1] != scene.t_max:
        _fail(place, "t_max", f"the last of track_times, {times[-1]!r}", repr(scene.t_max))
    if not 1 / _MOST_TIME <= scene.frames_per_unit <= _MOST_TIME:
        _fail(place, "frames_per_unit", f"a positive number up to {_MOST_TIME:g}", scene.frames_per_unit)
    if not _LEAST_LENGTH <= scene.near_plane <= cameras.FARTHEST:
        _fail(place, "near_plane", f"a positive depth up to {cameras.FARTHEST:g}", scene.near_plane)
    last = scene.track_poses[:, -1]
    off = np.abs(np.abs(last) - np.array([1.0, 0, 0, 0, 0, 0, 0])).max(axis=-1) > 1e-9 * max(1.0, scene.extent)
    if off.any():
        g = int(np.flatnonzero(off)[0])
        _fail(
            place, f"track_poses of group {g}", "the identity at t_max (poses are relative to the bind state)", last[g]
        )


def _check_objects(scene: Scene, place: str, guard: findings.Guard) -> None:
    with guard():
        ids = [item.id for item in scene.objects]
        if 0 not in ids or ids != sorted(set(ids)) or ids[0] < -1 or ids[-1] > _MOST_ID:
            _fail(place, "objects", f"increasing ids from -1 or 0 to {_MOST_ID}, with 0, the background", ids[:5])
    with guard():
        names = [item.name for item in scene.objects]
        if len(set(names)) != len(names):
            _fail(place, "objects", "unique names", f"{Counter(names).most_common(1)[0][0]!r} twice")
    with guard():
        _check_ranges(scene, place)
    for item in scene.objects:
        with guard():
            if not all(0 <= channel <= 1 for channel in item.color):
                _fail(place, f"object {item.name!r}", "a color of numbers from 0 to 1", item.color)
            rows = scene.motion_ids[item.start : item.start + item.count]
            if any(later[2] <= earlier[2] for earlier, later in pairwise(runs(rows))):
                _fail(place, f"motion_ids of object {item.name!r}", "increasing ids within the object", "another order")


def _check_ranges(scene: Scene, place: str) -> None:
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


def _check_group(scene: Scene, place: str, row: int, group: MotionGroup, object_ids: set[int]) -> None:
    where = f"motion group {row}"
    if group.id != row:
        _fail(place, where, f"id {row}", group.id)
    if group.role not in ROLES:
        _fail(place, where, f"a role out of {ROLES}", repr(group.role))
    if group.object_id not in object_ids:
        _fail(place, where, "an object of the table", group.object_id)
    if not -1 <= group.anchor_index < len(scene.means):
        _fail(place, where, f"an anchor_index below {len(scene.means)}, or -1", group.anchor_index)
    if np.shape(group.pivot) != (3,) or not (np.abs(group.pivot) <= cameras.FARTHEST).all():
        _fail(place, where, f"a pivot of three numbers up to {cameras.FARTHEST:g}", group.pivot)
    if not (0 <= group.rigid_rms <= cameras.FARTHEST and 0 <= group.rigid_max <= cameras.FARTHEST):
        _fail(place, where, f"rigid residuals from 0 to {cameras.FARTHEST:g}", (group.rigid_rms, group.rigid_max))
    _check_model(group.model, f"{place}: {where}: model")
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
    if matrix is None or matrix.shape != (3, 3) or not (np.abs(matrix) <= _LARGE).all():
        _fail(place, where, f"a follow_matrix (3, 3) of numbers up to {_LARGE:g}", group.follow_matrix)


def _check_model(model: MotionModel, place: str) -> None:
    """Raise `SceneFileError` with the name of a rate that playback cannot use."""
    for name, limit in _MODEL_LIMITS.items():
        value = np.max(np.abs(getattr(model, name)))
        if not value <= limit:
            _fail(place, name, f"numbers up to {limit:g}", f"{value:g}")
    if model.radius < _LEAST_LENGTH or model.fade_time < _LEAST_STEP:
        _fail(place, "radius and fade_time", f"{_LEAST_LENGTH:g} and {_LEAST_STEP:g} or more", "less")
