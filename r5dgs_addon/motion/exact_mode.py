"""The exact mode: what bends while observed is played, point by point, by a handler on frame changes.

Anchors move groups as a whole; residuals of the scene file say how single Gaussians leave that motion. Switched on, a
collection's clouds keep their bind state in attributes of their own, and each frame change writes their points anew.
Edits of points are taken over into the bind state. Nothing listens to frame changes while no scene has it on.
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

_WRITTEN = "r5dgs_exact_written"  # custom property of point clouds: fingerprints of what was written, and its time

_log = logging.getLogger(__name__)
_told: set[str] = set()  # errors that were logged


class R5DGS_PG_exact(bpy.types.PropertyGroup):
    """Whether a loaded scene plays what bends."""

    enabled: BoolProperty(name="Exact", description="Whether points that bend while observed are played", options=set())
    locked: BoolProperty(name="Lock", description="Whether Lock Interface was on before", options={"HIDDEN"})
    problem: StringProperty(name="Problem", description="Why nothing bends although it should", options={"HIDDEN"})


@dataclass(frozen=True)
class _File:
    """Residuals and centres of a scene file. means [N, 3]"""

    bending: Residuals
    means: np.ndarray


def _read_file(path: Path) -> _File:
    scene = scene_file.read(path)
    return _File(residuals.Residuals(scene), scene.means)


# In quotes: `typing` would keep the class, and with it this module, until after Blender has ended, which crashes then.
_files: "file_cache.Remembered[_File]" = file_cache.Remembered(_read_file)
_turns: dict[int, tuple[str, tuple[np.ndarray, np.ndarray] | None]] = {}  # by session_uid, see `_turn_of`


def residuals_of(collection: bpy.types.Collection, again: bool = False) -> Residuals:
    """Return the residuals of a loaded scene; its file is read once for each state of it.

    Args:
        collection: The scene.
        again: Read a file anew that could not be read before.

    Raises:
        SceneFileError: The file is missing, may not be read (`trust`), cannot be read, or is of another scene.
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
    """Play what bends, from now on. Returns how many Gaussians do.

    Raises:
        SceneFileError: The file cannot be read.
        ConfigError: Nothing in it bends, or its points lie in another .blend file.
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
    """Bring the points back to their bind state, and listen no more where no other scene needs it."""
    state = collection.r5dgs_exact
    for cloud in loaded_scenes.members(collection, "CLOUD"):
        _give_back(cloud.data)
    if state.enabled and not state.locked:
        context.scene.render.use_lock_interface = False
    state.enabled, state.problem = False, ""
    listen()


def apply(collection: bpy.types.Collection, frame: float) -> None:
    """Write the points of a scene as they are at a frame, sub-frame included. Edits of points are kept.

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
    """Row of the scene file that each point is; none if the attribute is missing. [n]"""
    named = point_clouds.attribute(cloud, point_clouds.ROW, "INT")
    return np.zeros(0, np.int32) if named is None else point_clouds.read(named, "value", 1, np.int32)[:, 0]


def _bending_points(rows: np.ndarray, bending: Residuals) -> tuple[np.ndarray, np.ndarray]:
    """Points of a cloud that have residuals, and which residuals those are; deleted points have none. [n], [n]"""
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
    """Bend points as they are at a time, or bend them back. Returns new arrays."""
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
    """Find the map that residuals follow after *Apply Transform*, as `point_edits` does for pictures.

    Args:
        cloud: The points.
        means: Centres in the scene file. [N, 3]
        rows: Row of each point. [n]
        position: Centres in the bind state. [n, 3]

    Returns:
        The linear map [3, 3] and the points that it moves [n] bool; None if nothing was transformed.
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
    """Return True if points are no longer as `apply` wrote them."""
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
    """Take edits of the points since `apply` over into their bind state, ``bind``, which is changed."""
    if not _is_edited(cloud):
        return
    turn, t = _turn_of(cloud, file.means, rows, bind["position"]), cloud[_WRITTEN]["t"]
    written = _bend(bind, file.bending, t, points, part, turn)
    now = {name: point_clouds.read(cloud.attributes[name], field, width) for name, _, field, width in PARTS}
    back = _bend(now, file.bending, t, points, part, turn, back=True)
    found = point_edits.affine_between(written["position"], now["position"])
    if found is not None:  # the offsets follow the map, too
        matrix, inside = found
        back["position"][inside] = bind["position"][inside] @ matrix[:3, :3].T + matrix[:3, 3]
    for name, _, field, _ in PARTS:
        changed = (now[name] != written[name]).any(-1)
        bind[name][changed] = back[name][changed]
        cloud.attributes[BIND + name].data.foreach_set(field, bind[name].ravel())


def _bind_state(cloud: bpy.types.PointCloud) -> dict[str, np.ndarray]:
    """The bind state of a cloud's points, kept in attributes from the first call on: position, rotation, scale."""
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
    """Keep edits of points at once, as pictures show the bind state."""
    updated = set() if depsgraph is None else {one.id.original for one in depsgraph.updates if one.is_updated_geometry}
    if not updated:
        return
    for collection in _exact_scenes():
        members = loaded_scenes.members(collection, "CLOUD")
        if any((one in updated or one.data in updated) and _is_edited(one.data) for one in members):
            _try(collection, scene.frame_current_final)


def _try(collection: bpy.types.Collection, frame: float) -> None:
    """`apply`; an error is shown in the sidebar and logged once, as a handler cannot report it."""
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
    """Bring the points of all scenes to the frame, once a file can be read that could not be before."""
    for collection in _exact_scenes():
        _try(collection, bpy.context.scene.frame_current_final)


@persistent
def _look_again(*_):
    """After loading, undo and redo: listen where it is on, and bring the points to the frame."""
    listen()
    refresh()


def listen() -> None:
    """Listen to frame changes and edits exactly while some scene plays what bends."""
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
    """Register the group, and look for scenes that play what bends whenever a file or a state is loaded."""
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
