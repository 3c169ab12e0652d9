"""Exact Mode: per-Gaussian residual motion, applied to the points by a frame change handler.

Anchors move groups rigidly. Residuals of the scene file describe how single Gaussians deviate from that motion. With
Exact Mode on, the point clouds that bend keep their bind state in additional attributes, and each frame change writes
their points; keys and other edits of motion work as without it. Edits of points are transferred to the bind state.
Loading a scene with residuals switches the mode on. Handlers are installed only while a scene uses it.
"""

import logging
from pathlib import Path

import bpy
from bpy.app.handlers import persistent
from bpy.props import BoolProperty, PointerProperty, StringProperty

from ...r5dgs_core import errors
from ...r5dgs_core.playback.residuals import Residuals
from ...r5dgs_core.scene import scene_file
from ...r5dgs_core.scene.scene import Scene
from ..engine import render_request
from ..scene import file_cache, loaded_scenes, retiming, timeline
from . import exact_points
from .exact_points import File

_log = logging.getLogger(__name__)
_told: set[str] = set()  # errors already logged
_collections = [0]  # number of collections at the last update


class R5DGS_PG_exact(bpy.types.PropertyGroup):
    """Exact Mode state of a loaded scene."""

    enabled: BoolProperty(name="Exact", description="Play the residual motion of single Gaussians", options=set())
    locked: BoolProperty(name="Lock", description="State of Lock Interface before Exact Mode", options={"HIDDEN"})
    problem: StringProperty(name="Problem", description="Error that prevents the residual motion", options={"HIDDEN"})


def _content(scene: Scene) -> File:
    return File(Residuals(scene), scene.gaussians.means)


def _read_file(path: Path) -> File:
    return _content(scene_file.read(path))


# The type is quoted, because `typing` would keep the class, and with it this module, alive beyond Blender's exit, and
# Blender would crash.
_files: "file_cache.Remembered[File]" = file_cache.Remembered(_read_file)


def _file_of(collection: bpy.types.Collection, again: bool = False) -> File:
    """Return the file of a loaded scene. It is read once per version.

    Args:
        collection: Loaded scene.
        again: True to retry a file that could not be read before.

    Raises:
        SceneFileError: The file is missing, not trusted (`trust`), unreadable, or that of another scene.
    """
    path = render_request.scene_path(collection)
    found = _files.get(path, again)
    if len(found.means) != collection.r5dgs.gaussians:
        raise errors.SceneFileError(
            f"{path}: expected the {collection.r5dgs.gaussians} Gaussians that were loaded, found {len(found.means)}; "
            "load the scene again"
        )
    return found


def switch_on(context: bpy.types.Context, collection: bpy.types.Collection, scene: Scene | None = None) -> int:
    """Enable Exact Mode.

    Args:
        context: Context whose frame is applied.
        collection: Loaded scene.
        scene: Content of its file if the caller has just read it.

    Returns:
        Number of Gaussians with residual motion.

    Raises:
        SceneFileError: The file cannot be read.
        ConfigError: The scene has no residual motion, or its points belong to another .blend file.
    """
    if collection.library is not None or any(c.data.library for c in loaded_scenes.members(collection, "CLOUD")):
        raise errors.ConfigError(f"{collection.name}: its points lie in another .blend file; append the scene instead")
    if scene is not None:
        _files.put(render_request.scene_path(collection), _content(scene))
    count = len(_file_of(collection, again=True).bending.rows)
    if not count:
        raise errors.ConfigError(f"{collection.name}: all objects are rigid; there is no residual motion to play")
    state = collection.r5dgs_exact
    if not state.enabled:
        state.locked = context.scene.render.use_lock_interface
    state.enabled, state.problem = True, ""
    context.scene.render.use_lock_interface = True
    apply(collection, context.scene.frame_current_final)
    listen()
    return count


def switch_off(context: bpy.types.Context, collection: bpy.types.Collection) -> None:
    """Disable Exact Mode: restore the bind state, and remove the handlers if no other scene uses them."""
    state = collection.r5dgs_exact
    for cloud in loaded_scenes.members(collection, "CLOUD"):
        exact_points.restore_bind_state(cloud.data)
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
    times = timeline.of_collection(collection)
    for cloud, obj in {obj.data: obj for obj in reversed(loaded_scenes.members(collection, "CLOUD"))}.items():
        if cloud.library is None:
            exact_points.write(cloud, file, times.time(retiming.source_frame(obj, frame)))


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
    exact_points.check_again(one.session_uid for one in updated)
    for collection in _exact_scenes():
        members = loaded_scenes.members(collection, "CLOUD")
        if any((one in updated or one.data in updated) and exact_points.is_edited(one.data) for one in members):
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
            _log.warning("R5DGS: %s: Exact Mode cannot play the residual motion: %s", collection.name, problem)
    if collection.r5dgs_exact.problem != problem:
        collection.r5dgs_exact.problem = problem


@persistent
def _notice_import(*_):
    """Start playing scenes that were appended. Blender has no event for this before 4.3; a new collection shows it."""
    if len(bpy.data.collections) == _collections[0]:
        return
    _collections[0] = len(bpy.data.collections)
    silent = _follow_frame not in bpy.app.handlers.frame_change_pre
    listen()
    if silent:
        refresh()


def refresh() -> None:
    """Update the points of all scenes, for example after a file became readable."""
    for collection in _exact_scenes():
        _try(collection, bpy.context.scene.frame_current_final)


@persistent
def _look_again(*_):
    """Update handlers and points after loading, undo and redo."""
    exact_points.forget()
    _collections[0] = len(bpy.data.collections)
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
    bpy.app.handlers.depsgraph_update_post.append(_notice_import)


def unregister():
    """Undo `register`."""
    for events in (bpy.app.handlers.load_post, bpy.app.handlers.undo_post, bpy.app.handlers.redo_post):
        if _look_again in events:
            events.remove(_look_again)
    if _notice_import in bpy.app.handlers.depsgraph_update_post:
        bpy.app.handlers.depsgraph_update_post.remove(_notice_import)
    for events, handler in _hooks():
        if handler in events:
            events.remove(handler)
    _files.clear()
    exact_points.forget()
    _told.clear()
    del bpy.types.Collection.r5dgs_exact
    bpy.utils.unregister_class(R5DGS_PG_exact)
