"""Splats in every 3D viewport: a draw handler that pastes the picture of each view and draws it again if it changed.

Blender calls the handler for every anti-aliasing sample, so pictures are kept. A picture depends on the view, the
poses, tints and points of the visible groups and, if anything solid is visible, on all other changes of the scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import gpu
import numpy as np
from bpy.app.handlers import persistent
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ...r5dgs_core import errors
from ...r5dgs_core.color import srgb
from ...r5dgs_core.playback import affine_transform, posing
from ...r5dgs_core.scene import spherical_harmonics
from ..engine import visible_clouds
from ..scene import evaluated_points, loaded_scenes, render_settings, viewport_display
from ..ui import status_bar
from . import gaussian_table, shaders
from . import splat_renderer as renderer

SOLID = {"MESH", "CURVE", "SURFACE", "META", "FONT", "VOLUME", "CURVES", "POINTCLOUD", "GPENCIL", "GREASEPENCIL"}
KEPT = 16  # viewports whose pictures are kept
UNKNOWN = (0.5, 0.5, 0.5)  # background that is assumed behind soft edges if its color cannot be read


@dataclass(frozen=True)
class Shown:
    """Visible splats of a viewport.

    Attributes:
        table: Their Gaussians.
        groups: The visible groups.
        sky: Coefficients of the sky, [K, 3], or None; of the first scene.
        world: Map from that scene's world to Blender's. [4, 4]
    """

    table: renderer.SplatTable
    groups: tuple[renderer.Group, ...]
    sky: np.ndarray | None
    world: np.ndarray


class _Picture:
    """Last picture of a viewport, and the state that it shows."""

    def __init__(self):
        self.buffer, self.key, self.meshes = renderer.SplatBuffer(), None, None


class _State:
    """Everything that the handler keeps between draws."""

    def __init__(self):
        self.handle = None
        self.failure = ""
        self.message = ""
        self.changes = 0
        self.pictures: dict[int, _Picture] = {}
        self.clouds: dict[int, gaussian_table.CloudData | None] = {}  # by `session_uid` of the object
        self.table: tuple[tuple, renderer.SplatTable] | None = None
        self.paste = None
        self.solid: dict[int, tuple[int, bool]] = {}

    def forget(self) -> None:
        """Release the pictures, tables and shaders."""
        self.pictures.clear()
        self.clouds.clear()
        self.solid.clear()
        self.table = self.paste = None
        renderer.forget()


_state = _State()


def message() -> str:
    """Reason why the viewports draw no splats, or ""."""
    return _state.failure or _state.message


def shown(depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D | None = None) -> Shown | None:
    """Return the visible splats of the loaded scenes with display *Splats*, or None if there are none.

    Args:
        depsgraph: Evaluated depsgraph.
        space: 3D view whose local view is respected.

    Raises:
        ConfigError: A point cloud has lost points and cannot be matched with its scene file.
    """
    scenes, clouds = visible_clouds.instances(depsgraph, space)
    clouds = [one for one in clouds if one.seen and one.collection.r5dgs.display == viewport_display.SPLATS]
    data = {one.object.session_uid: _read(one.object, depsgraph) for one in clouds}
    clouds = [one for one in clouds if data[one.object.session_uid] is not None]
    if not clouds:
        return None
    slots = _slots(clouds)
    if _state.table is None or not set(slots) <= set(_state.table[0]):
        packed = gaussian_table.pack([data[uid] for uid, *_ in slots])
        _state.table = slots, renderer.SplatTable(packed)
    numbers = {slot: number for number, slot in enumerate(_state.table[0])}
    groups = tuple(_group(numbers[slot], one) for slot, one in zip(slots, clouds, strict=True))
    first = scenes[0]
    return Shown(_state.table[1], groups, _sky(first), visible_clouds.world_of(first, depsgraph))


def _slots(clouds: list[visible_clouds.VisibleCloud]) -> tuple[tuple[int, int, int], ...]:
    """Keys of clouds in the table: object, instancer, and a number for several instances by one instancer."""
    found: list[tuple[int, int, int]] = []
    numbers: dict[tuple[int, int], int] = {}
    for one in clouds:
        key = (one.object.session_uid, 0 if one.parent is None else one.parent.session_uid)
        numbers[key] = numbers.get(key, -1) + 1
        found.append((*key, numbers[key]))
    return tuple(found)


def _read(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> gaussian_table.CloudData | None:
    """Read an object's evaluated points, or return them from the cache."""
    key = obj.session_uid
    if key not in _state.clouds:
        _state.clouds[key] = gaussian_table.read(evaluated_points.evaluated(obj, depsgraph))
    return _state.clouds[key]


def _group(number: int, cloud: visible_clouds.VisibleCloud) -> renderer.Group:
    tint = (0.0, 0.0, 0.0) if cloud.holdout else cloud.tint
    light = loaded_scenes.light(cloud.collection)
    if light is None:
        return renderer.Group(number, cloud.matrix, tint)
    turn = affine_transform.nearest_rotation(cloud.matrix[:3, :3])
    turn = affine_transform.nearest_rotation(cloud.world[:3, :3]).T @ turn
    return renderer.Group(number, cloud.matrix, tint, tuple(posing.light_change(light, turn)))


def _draw() -> None:
    """Draw the splats of the current viewport; Blender calls this after its scene and overlays."""
    context = bpy.context
    if _state.failure or context.region_data is None or not loaded_scenes.scene_collections():
        return
    if context.space_data.shading.type == "RENDERED" and context.scene.render.engine == "R5DGS":
        return
    try:
        found = shown(context.evaluated_depsgraph_get(), context.space_data)
        _state.message = ""
        if found is not None:
            _draw_in_region(context, found)
    except errors.R5dgsError as error:
        _state.message = str(error)
    except Exception as error:  # a shader that does not compile must not print at every redraw
        _state.failure = f"Splats cannot be drawn on this graphics card: {error}"
        bpy.app.timers.register(_show_points, first_interval=0.0)


def _draw_in_region(context: bpy.types.Context, found: Shown) -> None:
    region, space, view_3d = context.region, context.space_data, context.region_data
    picture = _picture(region.as_pointer())
    view = renderer.View(
        np.array(view_3d.view_matrix, np.float64),
        np.array(view_3d.window_matrix, np.float64),
        region.width,
        region.height,
        space.clip_start,
    )
    solid = _solid(context)
    key = (
        (view.view_matrix.tobytes(), view.projection.tobytes(), view.width, view.height, view.near),
        tuple((one.number, one.matrix.tobytes(), one.tint, one.light_change) for one in found.groups),
        (id(found.table), solid, _state.changes if solid else 0, space.shading.type),
    )
    if picture.key != key:
        picture.meshes = _depth(region.width, region.height) if solid else None
        picture.buffer.draw(found.table, found.groups, view, picture.meshes)
        picture.key = key
    wired = space.shading.type == "WIREFRAME"
    sky = found.sky if render_settings.of(context.scene).sky and not wired else None
    _paste(picture, view, sky, found.world, _behind(context))


def _picture(key: int) -> _Picture:
    """Kept picture of a region; the one that was not drawn for longest is dropped beyond `KEPT`."""
    picture = _state.pictures.pop(key, None) or _Picture()
    _state.pictures[key] = picture
    if len(_state.pictures) > KEPT:
        del _state.pictures[next(iter(_state.pictures))]
    return picture


def _depth(width: int, height: int) -> gpu.types.GPUTexture:
    """Depth buffer of the viewport as a texture. Reading it waits for the graphics card."""
    buffer = gpu.state.active_framebuffer_get().read_depth(0, 0, width, height)
    buffer.dimensions = width * height
    return gpu.types.GPUTexture((width, height), format="R32F", data=buffer)


def _solid(context: bpy.types.Context) -> bool:
    """Return True if the viewport may show anything solid but the splats."""
    key = context.space_data.as_pointer()
    known = _state.solid.get(key)
    if known is None or known[0] != _state.changes:
        depsgraph = context.evaluated_depsgraph_get()
        known = _state.changes, any(_is_solid(obj, context) for obj in depsgraph.objects)
        _state.solid[key] = known
    return known[1]


def _is_solid(obj: bpy.types.Object, context: bpy.types.Context) -> bool:
    if obj.instance_type == "COLLECTION" and obj.instance_collection is not None:
        return True
    if obj.type not in SOLID or not obj.original.visible_get(viewport=context.space_data):
        return False
    return obj.type != "POINTCLOUD" or not viewport_display.draws_splats(obj.original)


def _paste(picture: _Picture, view: renderer.View, sky: np.ndarray | None, world: np.ndarray, behind: tuple) -> None:
    """Blend a picture into the active framebuffer."""
    if _state.paste is None:
        shader = shaders.paste()
        _state.paste = shader, batch_for_shader(shader, "TRI_STRIP", renderer.CORNERS)
    shader, screen = _state.paste
    terms = renderer.nothing() if sky is None else _sky_texture(sky)  # has to live until it is drawn with
    gpu.state.depth_test_set("NONE")
    gpu.state.blend_set("ALPHA_PREMULT")
    shader.bind()
    shader.uniform_float("to_world", Matrix(_rays(view, world).tolist()))
    shader.uniform_float("behind", behind)
    shader.uniform_int("sky_degree", -1 if sky is None else spherical_harmonics.degree_of(len(sky)))
    shader.uniform_int("meshes_drawn", int(picture.meshes is not None))
    shader.uniform_sampler("splats", picture.buffer.texture)
    shader.uniform_sampler("meshes", picture.meshes or renderer.nothing())
    shader.uniform_sampler("sky_terms", terms)
    screen.draw(shader)
    gpu.state.blend_set("NONE")


def _sky_texture(sky: np.ndarray) -> gpu.types.GPUTexture:
    """Coefficients in one row: degree 0, then the others without gaps. [K, 3]"""
    texels = np.zeros((1 + gaussian_table.HARMONICS[3], 4), np.float32)
    texels[0, :3] = sky[0]
    texels[1:].reshape(-1)[: 3 * (len(sky) - 1)] = sky[1:].ravel()
    return renderer.texture(texels, len(texels), "RGBA32F")


def _rays(view: renderer.View, world: np.ndarray) -> np.ndarray:
    """Linear map from (x, y, 1, 1), x and y in [-1, 1] over the picture, to rays in the world of a scene. [4, 4]"""
    p, rays = view.projection, np.zeros((4, 4))
    if not view.parallel:
        rays[0, :3], rays[1, :3] = (1 / p[0, 0], 0, p[0, 2] / p[0, 0]), (0, 1 / p[1, 1], p[1, 2] / p[1, 1])
    rays[2, 2] = -1
    to_scene = np.linalg.inv(view.view_matrix @ world)
    to_scene[:3, 3] = 0
    return to_scene @ rays


def _sky(collection: bpy.types.Collection) -> np.ndarray | None:
    """Coefficients of a loaded scene's sky, or None for scenes of older versions. [K, 3]"""
    values = np.array(collection.get(loaded_scenes.SKY, ()), np.float32)
    return values.reshape(-1, 3) if values.size in (3, 12, 27, 48) else None


def _behind(context: bpy.types.Context) -> tuple[float, float, float]:
    """Display-referred color behind the splats without a sky, as far as it is known."""
    shading = context.space_data.shading
    if shading.type == "SOLID" and shading.background_type == "VIEWPORT":
        return tuple(srgb.from_linear(np.array(shading.background_color, np.float64)))
    if shading.type == "SOLID" and shading.background_type == "THEME":
        return tuple(context.preferences.themes[0].view_3d.space.gradients.high_gradient)
    return UNKNOWN


def _show_points() -> None:
    """Show points instead of splats in all loaded scenes."""
    for collection in loaded_scenes.scene_collections():
        if collection.r5dgs.display == viewport_display.SPLATS and loaded_scenes.is_own(collection):
            viewport_display.show(collection, viewport_display.POINTS)
    status_bar.redraw("VIEW_3D")


@persistent
def _follow_changes(_, depsgraph=None):
    """Count changes of the scene, and read the point clouds again whose geometry changed."""
    _state.changes += 1
    if depsgraph is None:
        return
    updated = {one.id.original.session_uid for one in depsgraph.updates if one.is_updated_geometry}
    stale = updated & _state.clouds.keys()
    for key in stale:
        del _state.clouds[key]
    if stale:
        _state.table = None


@persistent
def _forget_scene(*_):
    """Forget the points, because a file was opened or a change was undone."""
    _state.changes += 1
    _state.clouds.clear()
    _state.pictures.clear()
    _state.table = None


def _hooks():
    handlers = bpy.app.handlers
    forgetting = (handlers.load_post, handlers.undo_post, handlers.redo_post)
    following = (handlers.depsgraph_update_post, handlers.frame_change_post)
    return [*((events, _forget_scene) for events in forgetting), *((events, _follow_changes) for events in following)]


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
