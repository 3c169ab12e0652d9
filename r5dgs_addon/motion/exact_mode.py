"""Exact Mode: per-Gaussian residual motion, applied to the points by a frame change handler.

Anchors move groups rigidly. Residuals of the scene file describe how single Gaussians deviate from that motion. With
Exact Mode on, the point clouds of a scene keep their bind state in additional attributes, and each frame change writes
the points. Edits of points are transferred to the bind state. Handlers are installed only while a scene uses the mode.
"""

import logging
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from bpy.app.handlers import persistent
from bpy.props import BoolProperty, PointerProperty, StringProperty

from ...r5dgs_core import errors
from ...r5dgs_core.editing import point_edits
from ...r5dgs_core.motion import quaternion_columns
from ...r5dgs_core.playback import residuals
from ...r5dgs_core.playback.residuals import Residuals
from ...r5dgs_core.scene import scene_file
from ..engine import render_request
from ..scene import file_cache, loaded_scenes, point_clouds, timeline

BIND = point_clouds.BIND
PARTS = (
    ("position", "FLOAT_VECTOR", "vector", 3),
    ("rotation", "QUATERNION", "value", 4),
    ("scale", "FLOAT_VECTOR", "vector", 3),
)

_WRITTEN = "r5dgs_exact_written"  # custom property of point clouds: fingerprints and time of the written attributes

_log = logging.getLogger(__name__)
_told: set[str] = set()  # errors already logged


class R5DGS_PG_exact(bpy.types.PropertyGroup):
    """Exact Mode state of a loaded scene."""

    enabled: BoolProperty(name="Exact", description="Play the residual motion of single Gaussians", options=set())
    locked: BoolProperty(name="Lock", description="State of Lock Interface before Exact Mode", options={"HIDDEN"})
    problem: StringProperty(name="Problem", description="Error that prevents the residual motion", options={"HIDDEN"})


@dataclass(frozen=True)
class _File:
    """Residuals and centres of a scene file. means [N, 3]"""

    bending: Residuals
    means: np.ndarray


def _read_file(path: Path) -> _File:
    scene = scene_file.read(path)
    return _File(residuals.Residuals(scene), scene.gaussians.means)


# Quoted: `typing` would keep the class, and thus this module, alive until after Blender's exit, which crashes.
_files: "file_cache.Remembered[_File]" = file_cache.Remembered(_read_file)
_turns: dict[int, tuple[str, tuple[np.ndarray, np.ndarray] | None]] = {}  # cache by session_uid, see `_turn_of`


def residuals_of(collection: bpy.types.Collection, again: bool = False) -> Residuals:
    """Return the residuals of a loaded scene. The file is read once per version.

    Args:
        collection: Loaded scene.
        again: True to retry a file that could not be read before.

    Raises:
        SceneFileError: The file is missing, not trusted (`trust`), unreadable, or that of another scene.
    """
    return _file_of(collection, again).bending


def _file_of(collection: bpy.types.Collection, again: bool = False) -> _File:
    path = render_request.scene_path(collection)
    found = _files.get(path, again)
    if len(found.means) != collection.r5dgs.gaussians:
        raise errors.SceneFileError(
            f"{path}: expected the {collection.r5dgs.gaussians} Gaussians that were loaded, found {len(found.means)}; "
            "load the scene anew"
        )
    return found


def switch_on(context: bpy.types.Context, collection: bpy.types.Collection) -> int:
    """Enable Exact Mode. Returns the number of Gaussians with residual motion.

    Raises:
        SceneFileError: The file cannot be read.
        ConfigError: The scene has no residual motion, or its points belong to another .blend file.
    """
    if collection.library is not None or any(c.data.library for c in loaded_scenes.members(collection, "CLOUD")):
        raise errors.ConfigError(f"{collection.name}: its points lie in another .blend file; append the scene instead")
    bending = residuals_of(collection, again=True)
    if len(bending.rows) == 0:
        raise errors.ConfigError(f"{collection.name}: every object moves as a whole; there is nothing more to play")
    state = collection.r5dgs_exact
    if not state.enabled:
        state.locked = context.scene.render.use_lock_interface
    state.enabled, state.problem = True, ""
    context.scene.render.use_lock_interface = True
    apply(collection, context.scene.frame_current_final)
    listen()
    return len(bending.rows)


def switch_off(context: bpy.types.Context, collection: bpy.types.Collection) -> None:
    """Disable Exact Mode: restore the bind state, and remove the handlers if no other scene uses them."""
    state = collection.r5dgs_exact
    for cloud in loaded_scenes.members(collection, "CLOUD"):
        _give_back(cloud.data)
    if state.enabled and not state.locked:
        context.scene.render.use_lock_interface = False
    state.enabled, state.problem = False, ""
    listen()


def apply(collection: bpy.types.Collection, frame: float) -> None:
    """Write the points of a scene at a frame, sub-frame included. Edits of points are kept.

    Raises:
        SceneFileError: The scene's file cannot be read.
    """
    file = _file_of(collection)
    t = timeline.of_collection(collection).time(frame)
    done = set()
    for cloud in loaded_scenes.members(collection, "CLOUD"):
        if cloud.data in done or cloud.data.library is not None:
            continue
        done.add(cloud.data)
        rows = _rows(cloud.data)
        points, part = _bending_points(rows, file.bending)
        if len(points) == 0:
            continue
        bind = _bind_state(cloud.data)
        _keep_edits(cloud.data, file, rows, points, part, bind)
        bent = _bend(bind, file.bending, t, points, part, _turn_of(cloud.data, file.means, rows, bind["position"]))
        for name, _, field, _ in PARTS:
            cloud.data.attributes[name].data.foreach_set(field, bent[name].ravel())
        cloud.data[_WRITTEN] = {"t": t, **{name: point_clouds.fingerprint(values) for name, values in bent.items()}}
        cloud.data.update_tag()


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
    shapes = [cloud.attributes[BIND + name] for name in ("rotation", "scale")]
    for attribute, (name, _, field, width) in zip(shapes, PARTS[1:], strict=True):
        if point_clouds.fingerprint(point_clouds.view(attribute, field, width)) != stored.get(name):
            return None
    if _turns.get(cloud.session_uid, ("",))[0] != now:
        found = point_edits.affine_between(means[rows], position)
        linear = None if found is None else found[0][:3, :3]
        carried = (means[rows] != position).any(-1)
        _turns[cloud.session_uid] = now, None if linear is None else (linear, carried)
    return _turns[cloud.session_uid][1]


def _is_edited(cloud: bpy.types.PointCloud) -> bool:
    """Return True if points differ from those written by `apply`."""
    written = cloud.get(_WRITTEN)
    if written is None:
        return False
    every = ((point_clouds.attribute(cloud, name, kind), name, field, width) for name, kind, field, width in PARTS)
    return any(
        found is not None and point_clouds.fingerprint(point_clouds.view(found, field, width)) != written[name]
        for found, name, field, width in every
    )


def _keep_edits(
    cloud: bpy.types.PointCloud,
    file: _File,
    rows: np.ndarray,
    points: np.ndarray,
    part: np.ndarray,
    bind: dict[str, np.ndarray],
) -> None:
    """Transfer edits of the points since `apply` to the bind state ``bind``, in place."""
    if not _is_edited(cloud):
        return
    turn, t = _turn_of(cloud, file.means, rows, bind["position"]), cloud[_WRITTEN]["t"]
    written = _bend(bind, file.bending, t, points, part, turn)
    now = {name: point_clouds.read(cloud.attributes[name], field, width) for name, _, field, width in PARTS}
    back = _bend(now, file.bending, t, points, part, turn, back=True)
    found = point_edits.affine_between(written["position"], now["position"])
    if found is not None:  # offsets of the map, too
        matrix, inside = found
        back["position"][inside] = bind["position"][inside] @ matrix[:3, :3].T + matrix[:3, 3]
    for name, _, field, _ in PARTS:
        changed = (now[name] != written[name]).any(-1)
        bind[name][changed] = back[name][changed]
        cloud.attributes[BIND + name].data.foreach_set(field, bind[name].ravel())


def _bind_state(cloud: bpy.types.PointCloud) -> dict[str, np.ndarray]:
    """Bind state of a point cloud's points, stored in attributes on the first call: position, rotation, scale."""
    result = {}
    for name, kind, field, width in PARTS:
        values = np.empty(width * len(cloud.points), np.float32)
        kept = cloud.attributes.get(BIND + name)
        if kept is None:
            cloud.attributes[name].data.foreach_get(field, values)
            kept = cloud.attributes.new(BIND + name, kind, "POINT")
            kept.data.foreach_set(field, values)
        else:
            kept.data.foreach_get(field, values)
        result[name] = values.reshape(-1, width)
    return result


def _give_back(cloud: bpy.types.PointCloud) -> None:
    for name, _, field, width in PARTS:
        kept = cloud.attributes.get(BIND + name)
        if kept is None:
            continue
        values = np.empty(width * len(cloud.points), np.float32)
        kept.data.foreach_get(field, values)
        cloud.attributes[name].data.foreach_set(field, values)
        cloud.attributes.remove(cloud.attributes[BIND + name])
    cloud.pop(_WRITTEN, None)
    cloud.update_tag()


def _exact_scenes() -> list[bpy.types.Collection]:
    return [collection for collection in loaded_scenes.scene_collections() if collection.r5dgs_exact.enabled]


@persistent
def _follow_frame(scene, *_):
    for collection in _exact_scenes():
        _try(collection, scene.frame_current_final)


@persistent
def _follow_edits(scene, depsgraph=None):
    """Transfer edits of points immediately, because rendering uses the bind state."""
    updated = set() if depsgraph is None else {one.id.original for one in depsgraph.updates if one.is_updated_geometry}
    if not updated:
        return
    for collection in _exact_scenes():
        members = loaded_scenes.members(collection, "CLOUD")
        if any((one in updated or one.data in updated) and _is_edited(one.data) for one in members):
            _try(collection, scene.frame_current_final)


def _try(collection: bpy.types.Collection, frame: float) -> None:
    """Run `apply`. Errors are shown in the sidebar and logged once, because handlers cannot report them."""
    try:
        apply(collection, frame)
        problem = ""
    except errors.R5dgsError as error:
        problem = str(error)
        if problem not in _told:
            _told.add(problem)
            _log.warning("R5DGS: %s: Exact Mode plays nothing that bends: %s", collection.name, problem)
    if collection.r5dgs_exact.problem != problem:
        collection.r5dgs_exact.problem = problem


def refresh() -> None:
    """Update the points of all scenes, for example after a file became readable."""
    for collection in _exact_scenes():
        _try(collection, bpy.context.scene.frame_current_final)


@persistent
def _look_again(*_):
    """Update handlers and points after loading, undo and redo."""
    listen()
    refresh()


def listen() -> None:
    """Install the handlers if any scene uses Exact Mode, otherwise remove them."""
    playing = bool(_exact_scenes())
    for events, handler in _hooks():
        if playing and handler not in events:
            events.append(handler)
        elif not playing and handler in events:
            events.remove(handler)


def _hooks():
    handlers = bpy.app.handlers
    return (handlers.frame_change_pre, _follow_frame), (handlers.depsgraph_update_post, _follow_edits)


def register():
    """Register the property group, and the handlers that check for Exact Mode after loading and undo."""
    bpy.utils.register_class(R5DGS_PG_exact)
    bpy.types.Collection.r5dgs_exact = PointerProperty(type=R5DGS_PG_exact)
    for events in (bpy.app.handlers.load_post, bpy.app.handlers.undo_post, bpy.app.handlers.redo_post):
        events.append(_look_again)


def unregister():
    """Undo `register`."""
    for events in (bpy.app.handlers.load_post, bpy.app.handlers.undo_post, bpy.app.handlers.redo_post):
        if _look_again in events:
            events.remove(_look_again)
    for events, handler in _hooks():
        if handler in events:
            events.remove(handler)
    _files.clear()
    _turns.clear()
    _told.clear()
    del bpy.types.Collection.r5dgs_exact
    bpy.utils.unregister_class(R5DGS_PG_exact)
