"""Splats in every 3D viewport: a draw handler that pastes the picture of each view and draws it again if it changed.

Blender calls the handler for every anti-aliasing sample, so pictures are kept. A picture depends on the view, on the
poses, tints and points of the visible groups and, if anything else is visible, on the viewport's depth buffer.
"""

from __future__ import annotations

import traceback

import bpy
import gpu
import numpy as np
from bpy.app.handlers import persistent

from ...r5dgs_core import errors
from ..engine import engine
from ..scene import loaded_scenes, render_settings, viewport_display
from ..ui import status_bar
from . import camera_images, mesh_depth, paste, shaders, visible_splats
from . import splat_renderer as renderer

SOLID = {"MESH", "CURVE", "SURFACE", "META", "FONT", "VOLUME", "CURVES", "POINTCLOUD", "GPENCIL", "GREASEPENCIL"}
LINES = {"EMPTY", "CAMERA", "LIGHT", "SPEAKER", "LIGHT_PROBE", "LATTICE", "ARMATURE"}  # drawn by overlays


class _Picture:
    """Last picture of a viewport, and the state that it shows."""

    def __init__(self):
        self.buffer, self.key = renderer.SplatBuffer(), None
        self.depth: np.ndarray | tuple | None = None  # of the solid geometry, or what it depends on
        self.meshes: gpu.types.GPUTexture | None = None  # the depth
        self.drawn = mesh_depth.MeshDepth()


class _State:
    """Everything that the handler keeps between draws."""

    def __init__(self):
        self.handle = None
        self.failure = ""
        self.messages: dict[visible_splats.LayerKey, str] = {}
        self.pictures: dict[int, _Picture] = {}  # by address of the region

    def forget(self) -> None:
        """Release the pictures, tables and shaders."""
        self.failure = ""
        self.messages.clear()
        self.pictures.clear()
        visible_splats.forget()
        paste.forget()
        mesh_depth.forget()
        renderer.forget()


_state = _State()


def message(context: bpy.types.Context) -> str:
    """Reason why the viewports of a view layer draw no splats, or ""."""
    return _state.failure or _state.messages.get(visible_splats.layer_key(context.scene, context.view_layer), "")


def _draw() -> None:
    """Draw the splats of the current viewport; Blender calls this after its scene and overlays."""
    _draw_viewport(bpy.context)


def _draw_viewport(context: bpy.types.Context) -> None:
    if context.region_data is None:
        return
    loaded = loaded_scenes.scene_collections()
    if _state.failure:
        if any(_falls_back(one) for one in loaded) and not bpy.app.timers.is_registered(_show_points):
            bpy.app.timers.register(_show_points, first_interval=0.0)
        return
    catch_up()
    said, drawn = "", False
    try:
        if loaded and not _is_drawn_by_engine(context):
            found = visible_splats.shown(context.evaluated_depsgraph_get(), context.space_data)
            drawn = found is not None
            if drawn:
                _draw_in_region(context, found)
    except shaders.CompileError as error:
        _state.forget()
        _state.failure = f"Points are shown, because this graphics card cannot draw splats: {error}"
        bpy.app.timers.register(_show_points, first_interval=0.0)
        return
    except errors.R5dgsError as error:
        said = str(error)
    except Exception as error:
        said = f"Splats could not be drawn: {type(error).__name__}: {error}"
        if said != message(context):  # not at every redraw
            traceback.print_exc()
    if not drawn:
        _state.pictures.pop(context.region.as_pointer(), None)
    if said != message(context):
        _state.messages[visible_splats.layer_key(context.scene, context.view_layer)] = said
        status_bar.redraw("VIEW_3D")


def catch_up() -> None:
    """Apply the changes that handlers have queued."""
    changed = visible_splats.catch_up()
    if changed is None or changed:
        mesh_depth.drop(changed)


def _is_drawn_by_engine(context: bpy.types.Context) -> bool:
    return context.space_data.shading.type == "RENDERED" and context.scene.render.engine == engine.ENGINE


def _draw_in_region(context: bpy.types.Context, found: visible_splats.VisibleSplats) -> None:
    region, space, view_3d = context.region, context.space_data, context.region_data
    picture = _state.pictures.setdefault(region.as_pointer(), _Picture())
    view = renderer.ViewMatrices(
        np.array(view_3d.view_matrix, np.float64),
        np.array(view_3d.window_matrix, np.float64),
        region.width,
        region.height,
    )
    key = (
        (view.view_matrix.tobytes(), view.projection.tobytes(), view.width, view.height),
        tuple((one.number, one.matrix.tobytes(), one.tint, one.light_change, one.holdout) for one in found.groups),
        id(found.table),  # kept by the picture's buffer, so no other table has this id
        tuple(found.table.versions),
    )
    solid = None
    if is_anything_else_drawn(context):
        if mesh_depth.is_needed(space):
            solid = picture.drawn.find(context.evaluated_depsgraph_get(), space)
        else:
            solid = depth(region.width, region.height)
    if picture.key != key or not _is_equal(picture.depth, solid):
        _drop_closed(context)
        picture.depth, picture.meshes = solid, None
        if isinstance(solid, tuple):
            picture.drawn.draw(view)
            picture.meshes = picture.drawn.texture
        elif solid is not None:
            picture.meshes = renderer.texture(solid, region.width, "R32F")
        picture.buffer.draw(found.table, found.groups, view, picture.meshes)
        picture.key = key
    wired = space.shading.type == "WIREFRAME"
    sky = found.sky if render_settings.of(context.scene).sky and not wired else None
    paste.paste(picture.buffer, picture.meshes, view, sky, found.world, paste.background(context))
    camera_images.draw(context)


def _drop_closed(context: bpy.types.Context) -> None:
    """Release the pictures of viewports that no window shows any more."""
    areas = [area for window in context.window_manager.windows for area in window.screen.areas]
    there = {region.as_pointer() for area in areas if area.type == "VIEW_3D" for region in area.regions}
    for key in _state.pictures.keys() - there - {context.region.as_pointer()}:
        del _state.pictures[key]


def depth(width: int, height: int) -> np.ndarray:
    """Depth of the active framebuffer, in handlers the viewport's; waits for the graphics card. [H * W] float32

    Blender keeps the depth of the first anti-aliasing sample, so that a view at rest has the same at every sample.
    """
    buffer = gpu.state.active_framebuffer_get().read_depth(0, 0, width, height)
    buffer.dimensions = width * height
    return np.array(buffer, np.float32)


def _is_equal(one: np.ndarray | tuple | None, other: np.ndarray | tuple | None) -> bool:
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return np.array_equal(one, other)
    return type(one) is type(other) and one == other


def is_anything_else_drawn(context: bpy.types.Context) -> bool:
    """Return True if the viewport may show anything but splats that has depth: solids, or lines of overlays."""
    return any(_has_depth(obj, context) for obj in context.evaluated_depsgraph_get().objects)


def _has_depth(obj: bpy.types.Object, context: bpy.types.Context) -> bool:
    if obj.instance_type == "COLLECTION" and obj.instance_collection is not None:
        return True
    if obj.type in LINES:
        lines = context.space_data.overlay.show_overlays and not obj.show_in_front and obj.original.r5dgs.role == "NONE"
        return lines and obj.original.visible_get(viewport=context.space_data)
    if obj.type not in SOLID or not obj.original.visible_get(viewport=context.space_data):
        return False
    return obj.type != "POINTCLOUD" or not viewport_display.draws_splats(obj.original)


def _falls_back(collection: bpy.types.Collection) -> bool:
    """Return True if a loaded scene can show points instead of splats. Linked ones cannot be changed."""
    return collection.r5dgs.display == viewport_display.SPLATS and loaded_scenes.is_own(collection)


def _show_points() -> None:
    """Show points instead of splats in all loaded scenes."""
    for collection in filter(_falls_back, loaded_scenes.scene_collections()):
        viewport_display.show(collection, viewport_display.POINTS)
    status_bar.redraw("VIEW_3D")


@persistent
def _follow_changes(_, depsgraph=None):
    """Queue the objects and point clouds whose geometry changed. Renders have a depsgraph of their own."""
    if depsgraph is not None and depsgraph.mode == "VIEWPORT":
        updated = [one.id.original.session_uid for one in depsgraph.updates if one.is_updated_geometry]
        visible_splats.queue_change(updated)


@persistent
def _follow_reload(*_):
    """Request that everything is read again, because a file was opened or a change was undone."""
    visible_splats.queue_reload()


def _hooks():
    handlers = bpy.app.handlers
    reloading = (handlers.load_post, handlers.undo_post, handlers.redo_post)
    following = (handlers.depsgraph_update_post, handlers.frame_change_post)
    return [*((events, _follow_reload) for events in reloading), *((events, _follow_changes) for events in following)]


def register():
    """Register the handlers; the one that draws only with a window."""
    for events, handler in _hooks():
        events.append(handler)
    if not bpy.app.background:
        _state.handle = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")


def unregister():
    """Undo `register` and release everything on the graphics card."""
    if _state.handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_state.handle, "WINDOW")
        _state.handle = None
    for events, handler in _hooks():
        if handler in events:
            events.remove(handler)
    if bpy.app.timers.is_registered(_show_points):
        bpy.app.timers.unregister(_show_points)
    _state.forget()
