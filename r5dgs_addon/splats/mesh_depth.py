"""Depth of the solid geometry in a viewport, drawn here if Blender leaves no depth buffer.

EEVEE and Cycles write none while the overlays of a view are hidden.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from . import shaders
from . import splat_renderer as renderer

KINDS = {"MESH", "CURVE", "SURFACE", "META", "FONT"}
OUTLINED = {"WIRE", "BOUNDS"}  # display types without surfaces
_shader = functools.cache(shaders.depth)


@dataclass(frozen=True)
class Surface:
    """Triangles of an object on the graphics card.

    Attributes:
        batch: The triangles, or None if there are none.
        data: `session_uid` of the object's data.
    """

    batch: gpu.types.GPUBatch | None
    data: int


_surfaces: dict[int, Surface] = {}  # by `session_uid` of the object


def is_needed(space: bpy.types.SpaceView3D) -> bool:
    """Return True if a view has no depth buffer that could be read."""
    return space.shading.type in ("MATERIAL", "RENDERED") and not space.overlay.show_overlays


def drop(changed: set[int] | None) -> None:
    """Forget the triangles of objects whose geometry changed, by `session_uid` of object or data; None for all."""
    for uid, surface in list(_surfaces.items()):
        if changed is None or uid in changed or surface.data in changed:
            del _surfaces[uid]


def forget() -> None:
    """Release everything on the graphics card."""
    _surfaces.clear()
    _shader.cache_clear()


class MeshDepth:
    """Picture of the depth in one view."""

    def __init__(self):
        self._picture: gpu.types.GPUOffScreen | None = None
        self._found: tuple[tuple[Surface, np.ndarray], ...] = ()

    @property
    def texture(self) -> gpu.types.GPUTexture:
        """Texture whose red channel is the depth in [0, 1]; 1 in empty pixels."""
        return self._picture.texture_color

    def find(self, depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D) -> tuple:
        """Find the visible surfaces. Returns a value that is equal if they are the same at the same places."""
        self._found = tuple(_visible(depsgraph, space))
        return tuple((id(surface.batch), matrix.tobytes()) for surface, matrix in self._found)

    def draw(self, view: renderer.ViewMatrices) -> None:
        """Draw the depth of the surfaces that were found."""
        self._picture = renderer.target(self._picture, view)
        shader = _shader()
        with self._picture.bind():
            gpu.state.active_framebuffer_get().clear(color=(1.0, 1.0, 1.0, 1.0), depth=1.0)
            gpu.state.blend_set("NONE")
            gpu.state.depth_test_set("LESS_EQUAL")
            gpu.state.depth_mask_set(True)
            shader.bind()
            for surface, matrix in self._found:
                shader.uniform_float("to_clip", renderer.matrix(view.projection @ view.view_matrix @ matrix))
                surface.batch.draw(shader)
            gpu.state.depth_mask_set(False)
            gpu.state.depth_test_set("NONE")


def _visible(depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D) -> Iterator[tuple[Surface, np.ndarray]]:
    for instance in depsgraph.object_instances:
        obj, shower = instance.object, instance.parent if instance.is_instance else instance.object
        if obj.type not in KINDS or not instance.show_self or obj.display_type in OUTLINED or shower is None:
            continue
        if not shower.original.visible_get(view_layer=depsgraph.view_layer, viewport=space):
            continue
        surface, matrix = _surface(obj), np.array(instance.matrix_world, np.float64)
        if surface.batch is not None and np.isfinite(matrix).all():
            yield surface, matrix


def _surface(obj: bpy.types.Object) -> Surface:
    """Triangles of an evaluated object."""
    uid = obj.original.session_uid
    if uid not in _surfaces:
        mesh = obj.data if obj.type == "MESH" else obj.to_mesh()
        data = getattr(obj.original.data, "session_uid", 0)
        _surfaces[uid] = Surface(None if mesh is None else _batch(mesh), data)
        if obj.type != "MESH":
            obj.to_mesh_clear()
    return _surfaces[uid]


def _batch(mesh: bpy.types.Mesh) -> gpu.types.GPUBatch | None:
    mesh.calc_loop_triangles()
    places = np.empty(3 * len(mesh.vertices), np.float32)
    corners = np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.vertices.foreach_get("co", places)
    mesh.loop_triangles.foreach_get("vertices", corners)
    if not len(corners):
        return None
    return batch_for_shader(_shader(), "TRIS", {"place": places.reshape(-1, 3)}, indices=corners.reshape(-1, 3))
