"""Points of one point cloud in Exact Mode: bind state in additional attributes, residual motion, edits."""

import weakref
from collections.abc import Iterable
from dataclasses import dataclass

import bpy
import numpy as np

from ...r5dgs_core.editing import point_edits
from ...r5dgs_core.motion import quaternion_columns
from ...r5dgs_core.playback.residuals import Residuals
from ..scene import point_clouds

_PARTS = (
    ("position", "FLOAT_VECTOR", "vector", 3),
    ("rotation", "QUATERNION", "value", 4),
    ("scale", "FLOAT_VECTOR", "vector", 3),
)

_rigid: dict[int, weakref.ref[Residuals]] = {}  # residuals that bend no point of a cloud, by session_uid
_turns: dict[int, tuple[str, tuple[np.ndarray, np.ndarray] | None]] = {}  # cache by session_uid, see `_turn_of`


@dataclass(frozen=True)
class File:
    """Residuals and centres of a scene file. means [N, 3]"""

    bending: Residuals
    means: np.ndarray


def write(cloud: bpy.types.PointCloud, file: File, t: float) -> None:
    """Write the points of a point cloud at a scene time. Edits of points are kept."""
    rigid = _rigid.get(cloud.session_uid)
    if rigid is not None and rigid() is file.bending:
        return
    rows = _rows(cloud)
    points, part = _bending_points(rows, file.bending)
    if len(points) == 0:
        _rigid[cloud.session_uid] = weakref.ref(file.bending)
        return
    bind = _bind_state(cloud)
    _keep_edits(cloud, file, rows, points, part, bind)
    bent = _bend(bind, file.bending, t, points, part, _turn_of(cloud, file.means, rows, bind["position"]))
    for name, _, field, _ in _PARTS:
        cloud.attributes[name].data.foreach_set(field, bent[name].ravel())
    cloud[point_clouds.WRITTEN] = {"t": t, **{name: point_clouds.fingerprint(values) for name, values in bent.items()}}
    cloud.update_tag()


def _rows(cloud: bpy.types.PointCloud) -> np.ndarray:
    """Scene file row of each point, or an empty array if the attribute is missing. [n]"""
    named = point_clouds.attribute(cloud, point_clouds.ROW, "INT")
    return np.zeros(0, np.int32) if named is None else point_clouds.read(named, "value", 1, np.int32)[:, 0]


def _bending_points(rows: np.ndarray, bending: Residuals) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the points with residuals, and of those residuals. [n], [n]"""
    if len(bending.rows) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    part = np.minimum(np.searchsorted(bending.rows, rows), len(bending.rows) - 1)
    points = np.flatnonzero(bending.rows[part] == rows)
    return points, part[points]


def _bend(
    values: dict[str, np.ndarray],
    bending: Residuals,
    t: float,
    points: np.ndarray,
    part: np.ndarray,
    turn: tuple[np.ndarray, np.ndarray] | None,
    back: bool = False,
) -> dict[str, np.ndarray]:
    """Apply the residual motion at a time to points, or undo it. Returns new arrays."""
    values, found = {name: array.copy() for name, array in values.items()}, bending.at(t)
    if found is None:
        return values
    offsets, turns, growths = (array[:, part] for array in found)
    if turn is not None:
        linear, carried = turn
        offsets = np.where(carried[points], linear @ offsets, offsets)
    if back:
        offsets, turns, growths = -offsets, turns * [[1], [-1], [-1], [-1]], -growths
    values["position"][points] += offsets.T
    values["rotation"][points] = quaternion_columns.multiply(turns.astype(np.float32), values["rotation"][points].T).T
    values["scale"][points] *= np.exp(growths.T)
    return values


def _turn_of(
    cloud: bpy.types.PointCloud, means: np.ndarray, rows: np.ndarray, position: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the linear map that residuals follow after *Apply Transform*, as `point_edits` does for rendering.

    Args:
        cloud: Point cloud.
        means: Centres in the scene file. [N, 3]
        rows: Scene file row of each point. [n]
        position: Centres in the bind state. [n, 3]

    Returns:
        Linear map [3, 3] and mask of the transformed points [n], or None if nothing was transformed.
    """
    stored = point_clouds.fingerprints(cloud)
    now = point_clouds.fingerprint(position)
    if stored.get("position") in (None, now) or not ((rows >= 0) & (rows < len(means))).all():
        return None
    shapes = [cloud.attributes[point_clouds.BIND + name] for name in ("rotation", "scale")]
    for attribute, (name, _, field, width) in zip(shapes, _PARTS[1:], strict=True):
        if point_clouds.fingerprint(point_clouds.view(attribute, field, width)) != stored.get(name):
            return None
    if _turns.get(cloud.session_uid, ("",))[0] != now:
        found = point_edits.affine_between(means[rows], position)
        linear = None if found is None else found[0][:3, :3]
        carried = (means[rows] != position).any(-1)
        _turns[cloud.session_uid] = now, None if linear is None else (linear, carried)
    return _turns[cloud.session_uid][1]


def is_edited(cloud: bpy.types.PointCloud) -> bool:
    """Return True if points differ from those written by `write`."""
    written = cloud.get(point_clouds.WRITTEN)
    if written is None:
        return False
    every = ((point_clouds.attribute(cloud, name, kind), name, field, width) for name, kind, field, width in _PARTS)
    return any(
        found is not None and point_clouds.fingerprint(point_clouds.view(found, field, width)) != written[name]
        for found, name, field, width in every
    )


def _keep_edits(
    cloud: bpy.types.PointCloud,
    file: File,
    rows: np.ndarray,
    points: np.ndarray,
    part: np.ndarray,
    bind: dict[str, np.ndarray],
) -> None:
    """Transfer edits of the points since `write` to the bind state ``bind``, in place."""
    if not is_edited(cloud):
        return
    turn, t = _turn_of(cloud, file.means, rows, bind["position"]), cloud[point_clouds.WRITTEN]["t"]
    written = _bend(bind, file.bending, t, points, part, turn)
    now = {name: point_clouds.read(cloud.attributes[name], field, width) for name, _, field, width in _PARTS}
    back = _bend(now, file.bending, t, points, part, turn, back=True)
    found = point_edits.affine_between(written["position"], now["position"])
    if found is not None:  # offsets of the map, too
        matrix, inside = found
        back["position"][inside] = bind["position"][inside] @ matrix[:3, :3].T + matrix[:3, 3]
    for name, _, field, _ in _PARTS:
        changed = (now[name] != written[name]).any(-1)
        bind[name][changed] = back[name][changed]
        cloud.attributes[point_clouds.BIND + name].data.foreach_set(field, bind[name].ravel())


def _bind_state(cloud: bpy.types.PointCloud) -> dict[str, np.ndarray]:
    """Bind state of a point cloud's points, stored in attributes on the first call: position, rotation, scale."""
    result = {}
    for name, kind, field, width in _PARTS:
        values = np.empty(width * len(cloud.points), np.float32)
        kept = cloud.attributes.get(point_clouds.BIND + name)
        if kept is None:
            cloud.attributes[name].data.foreach_get(field, values)
            kept = cloud.attributes.new(point_clouds.BIND + name, kind, "POINT")
            kept.data.foreach_set(field, values)
        else:
            kept.data.foreach_get(field, values)
        result[name] = values.reshape(-1, width)
    return result


def restore_bind_state(cloud: bpy.types.PointCloud) -> None:
    """Restore the bind state."""
    for name, _, field, width in _PARTS:
        kept = cloud.attributes.get(point_clouds.BIND + name)
        if kept is None:
            continue
        values = np.empty(width * len(cloud.points), np.float32)
        kept.data.foreach_get(field, values)
        cloud.attributes[name].data.foreach_set(field, values)
        cloud.attributes.remove(cloud.attributes[point_clouds.BIND + name])
    cloud.pop(point_clouds.WRITTEN, None)
    cloud.update_tag()


def check_again(uids: Iterable[int]) -> None:
    """Read the rows of point clouds again that had no residuals, by ``session_uid``, because they may have changed."""
    for uid in uids:
        _rigid.pop(uid, None)


def forget() -> None:
    """Clear all caches."""
    _rigid.clear()
    _turns.clear()
