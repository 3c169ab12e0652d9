"""The exact mode: what bends while observed is played, point by point, by a handler on frame changes.

Anchors move groups as a whole; residuals of the scene file say how single Gaussians leave that motion. Switched on, a
collection's clouds keep their bind state in attributes of their own, and each frame change writes their points anew.
Nothing listens to frame changes while no scene has it on.
"""

import logging
from pathlib import Path

import bpy
import numpy as np
from bpy.app.handlers import persistent
from bpy.props import BoolProperty, PointerProperty, StringProperty

from ..r5dgs_core import errors
from ..r5dgs_core.motion import columns
from ..r5dgs_core.scene import residuals, scene_file
from ..r5dgs_core.scene.residuals import Residuals
from . import clouds, objects, picture, remembered, timeline

BIND = clouds.BIND
PARTS = (
    ("position", "FLOAT_VECTOR", "vector", 3),
    ("rotation", "QUATERNION", "value", 4),
    ("scale", "FLOAT_VECTOR", "vector", 3),
)

_log = logging.getLogger(__name__)
_told: set[str] = set()  # errors that were logged


class R5DGS_PG_exact(bpy.types.PropertyGroup):
    """Whether a loaded scene plays what bends."""

    enabled: BoolProperty(name="Exact", description="Whether points that bend while observed are played", options=set())
    locked: BoolProperty(name="Lock", description="Whether Lock Interface was on before", options={"HIDDEN"})
    problem: StringProperty(name="Problem", description="Why nothing bends although it should", options={"HIDDEN"})


def _read_file(path: Path) -> tuple[int, Residuals]:
    """Number of Gaussians and the residuals of a scene file."""
    scene = scene_file.read(path)
    return len(scene.means), residuals.Residuals(scene)


_files: remembered.Remembered[tuple[int, Residuals]] = remembered.Remembered(_read_file)


def residuals_of(collection: bpy.types.Collection, again: bool = False) -> Residuals:
    """The residuals of a loaded scene; its file is read once for each state of it.

    Args:
        collection: The scene.
        again: Read a file anew that could not be read before.

    Raises:
        SceneFileError: The file is missing, may not be read (`trust`), cannot be read, or is of another scene.
    """
    path = picture.scene_path(collection)
    count, found = _files.get(path, again)
    if count != collection.r5dgs.gaussians:
        raise errors.SceneFileError(
            f"{path}: expected the {collection.r5dgs.gaussians} Gaussians that were loaded, found {count}; load the "
            "scene anew"
        )
    return found


def switch_on(context: bpy.types.Context, collection: bpy.types.Collection) -> int:
    """Play what bends, from now on. Returns how many Gaussians do.

    Raises:
        SceneFileError: The file cannot be read.
        ConfigError: Nothing in it bends, or its points lie in another .blend file.
    """
    if collection.library is not None or any(c.data.library for c in objects.members(collection, "CLOUD")):
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
    for cloud in objects.members(collection, "CLOUD"):
        _give_back(cloud.data)
    if state.enabled and not state.locked:
        context.scene.render.use_lock_interface = False
    state.enabled, state.problem = False, ""
    listen()


def apply(collection: bpy.types.Collection, frame: float) -> None:
    """Write the points of a scene as they are at a frame, sub-frame included.

    Raises:
        SceneFileError: The scene's file cannot be read.
    """
    bending = residuals_of(collection)
    found = bending.at(timeline.of_collection(collection).time(frame))
    done = set()
    for cloud in objects.members(collection, "CLOUD"):
        if cloud.data in done or cloud.data.library is not None:
            continue
        done.add(cloud.data)
        points, part = _bending_points(cloud.data, bending)
        if len(points) == 0:
            continue
        bind = _bind_state(cloud.data)
        if found is not None:
            offsets, turns, growths = (values[:, part] for values in found)
            bind["position"][points] += offsets.T
            bind["rotation"][points] = columns.multiply(turns.astype(np.float32), bind["rotation"][points].T).T
            bind["scale"][points] *= np.exp(growths.T)
        for name, _, field, _ in PARTS:
            cloud.data.attributes[name].data.foreach_set(field, bind[name].ravel())
        cloud.data.update_tag()


def _bending_points(cloud: bpy.types.PointCloud, bending: Residuals) -> tuple[np.ndarray, np.ndarray]:
    """Points of a cloud that have residuals, and which residuals those are; deleted points have none. [n], [n]"""
    named = cloud.attributes.get(clouds.ROW)
    if named is None or len(bending.rows) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    rows = np.empty(len(cloud.points), np.int32)
    named.data.foreach_get("value", rows)
    part = np.minimum(np.searchsorted(bending.rows, rows), len(bending.rows) - 1)
    points = np.flatnonzero(bending.rows[part] == rows)
    return points, part[points]


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
    cloud.update_tag()


def _exact_scenes() -> list[bpy.types.Collection]:
    return [collection for collection in objects.scene_collections() if collection.r5dgs_exact.enabled]


@persistent
def _follow_frame(scene, *_):
    for collection in _exact_scenes():
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
    """Listen to frame changes exactly while some scene plays what bends."""
    events = bpy.app.handlers.frame_change_pre
    if _exact_scenes():
        if _follow_frame not in events:
            events.append(_follow_frame)
    elif _follow_frame in events:
        events.remove(_follow_frame)


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
    if _follow_frame in bpy.app.handlers.frame_change_pre:
        bpy.app.handlers.frame_change_pre.remove(_follow_frame)
    _files.clear()
    _told.clear()
    del bpy.types.Collection.r5dgs_exact
    bpy.utils.unregister_class(R5DGS_PG_exact)
