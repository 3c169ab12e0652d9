"""Splats of several groups of Gaussians, drawn into an offscreen buffer."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ...r5dgs_core.scene import cameras
from . import gaussian_table, shaders
from .depth_order import DepthOrder

SLACK = 0.3  # the rasterizer's `frustum_slack`
CORNERS = {"corner": [(-1, -1), (1, -1), (-1, 1), (1, 1)]}
_shader = functools.cache(shaders.splats)


@dataclass(frozen=True)
class Group:
    """Visible group of Gaussians.

    Attributes:
        number: Index of the group in the table.
        matrix: Affine map from the group's frame to Blender's world. [4, 4]
        tint: Factors on the color.
        light_change: Change of the light's direction as seen from the group. [3]
    """

    number: int
    matrix: np.ndarray
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    light_change: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class View:
    """View of a picture.

    Attributes:
        view_matrix: Blender's world to the camera, looking along -z. [4, 4]
        projection: Camera to clip space, OpenGL. [4, 4]
        width: Pixels.
        height: Pixels.
        near: Depth below which a perspective view culls Gaussians.
    """

    view_matrix: np.ndarray
    projection: np.ndarray
    width: int
    height: int
    near: float = 0.01

    @property
    def parallel(self) -> bool:
        """True if the view is orthographic."""
        return cameras.is_parallel(self.projection)


def texture(values: np.ndarray, width: int, format: str) -> gpu.types.GPUTexture:
    """Create a texture with rows of ``width`` texels; the last row is padded with zeros. [n] or [n, 4]"""
    channels = values.shape[1] if values.ndim > 1 else 1
    height = max(-(-len(values) // width), 1)
    flat = np.zeros(width * height * channels, np.float32)
    flat[: values.size] = values.ravel()
    return gpu.types.GPUTexture((width, height), format=format, data=gpu.types.Buffer("FLOAT", len(flat), flat))


class SplatTable:
    """Textures of the Gaussians of all groups.

    Args:
        table: The Gaussians.
    """

    def __init__(self, table: gaussian_table.Table):
        self.positions, self.starts = table.positions, table.starts
        count, texels = table.texels.shape[:2]
        per_row = shaders.WIDTH // texels
        self.order_width = min(max(count, 1), shaders.WIDTH)
        self.shader = _shader(table.degree, table.shaded, texels, self.order_width)
        self.quads = batch_for_shader(self.shader, "TRI_STRIP", CORNERS)
        self.texture = texture(table.texels.reshape(-1, 4), per_row * texels, "RGBA32F")


class SplatBuffer:
    """Picture of splats for one view: display-referred colors, premultiplied, and coverage. Kept until drawn again."""

    def __init__(self):
        self._offscreen: gpu.types.GPUOffScreen | None = None
        self._table: SplatTable | None = None
        self._order: DepthOrder | None = None
        self._rows: np.ndarray | None = None
        self._rows_texture: gpu.types.GPUTexture | None = None

    @property
    def texture(self) -> gpu.types.GPUTexture:
        """Texture of the picture."""
        return self._offscreen.texture_color

    def draw(
        self, table: SplatTable, groups: Sequence[Group], view: View, meshes: gpu.types.GPUTexture | None = None
    ) -> None:
        """Draw groups of a table.

        Args:
            table: The Gaussians.
            groups: Visible groups, each at most once.
            view: The view.
            meshes: Depth buffer of what is solid, as large as the picture; None if nothing is.
        """
        size = (view.width, view.height)
        if self._offscreen is None or (self._offscreen.width, self._offscreen.height) != size:
            self._offscreen = gpu.types.GPUOffScreen(*size, format="RGBA32F")
        rows = self._sorted(table, groups, view)
        with self._offscreen.bind():
            gpu.state.active_framebuffer_get().clear(color=(0.0, 0.0, 0.0, 0.0))
            if len(rows):
                self._draw(table, groups, view, meshes, len(rows))

    def _sorted(self, table: SplatTable, groups: Sequence[Group], view: View) -> np.ndarray:
        """Rows of the visible Gaussians, from far to near, as an array and as a texture."""
        if self._table is not table or self._order is None:
            self._table, self._order, self._rows = table, DepthOrder(table.positions, table.starts), None
        planes = {group.number: -(view.view_matrix @ group.matrix)[2] for group in groups}
        rows = self._order.update(planes, view.near, view.parallel)
        if rows is not self._rows:
            self._rows = rows
            self._rows_texture = texture(rows.astype(np.float32), table.order_width, "R32F")
        return rows

    def _draw(
        self, table: SplatTable, groups: Sequence[Group], view: View, meshes: gpu.types.GPUTexture | None, count: int
    ) -> None:
        shader = table.shader
        poses = _poses(groups, len(table.starts) - 1, view)  # a texture has to live until it is drawn with
        gpu.state.depth_test_set("NONE")
        gpu.state.depth_mask_set(False)
        gpu.state.blend_set("ALPHA_PREMULT")
        shader.bind()
        shader.uniform_float("projection", Matrix(view.projection.tolist()))
        shader.uniform_float("view", (view.width, view.height, view.near, float(meshes is not None)))
        shader.uniform_float("slopes", _slopes(view.projection))
        shader.uniform_sampler("table", table.texture)
        shader.uniform_sampler("poses", poses)
        shader.uniform_sampler("order", self._rows_texture)
        shader.uniform_sampler("meshes", meshes or nothing())
        table.quads.draw_instanced(shader, instance_count=count)
        gpu.state.blend_set("NONE")


@functools.cache
def nothing() -> gpu.types.GPUTexture:
    """Texture of one texel, for samplers that are not used."""
    return texture(np.ones(1, np.float32), 1, "R32F")


def forget() -> None:
    """Release shaders and shared textures."""
    _shader.cache_clear()
    nothing.cache_clear()


def _slopes(p: np.ndarray) -> tuple[float, float, float, float]:
    """Bounds of x/-z (low, high) and y/-z (low, high) to which the point of linearisation is clamped."""
    return (
        (-1 + p[0, 2] - SLACK) / p[0, 0],
        (1 + p[0, 2] + SLACK) / p[0, 0],
        (-1 + p[1, 2] - SLACK) / p[1, 1],
        (1 + p[1, 2] + SLACK) / p[1, 1],
    )


def _poses(groups: Sequence[Group], count: int, view: View) -> gpu.types.GPUTexture:
    """Texture of what the shader needs of each group, a row each."""
    rows = np.zeros((count, shaders.POSE_TEXELS, 4), np.float32)
    to_world = np.linalg.inv(view.view_matrix)
    for group in groups:
        row = rows[group.number]
        row[:3] = (view.view_matrix @ group.matrix)[:3]
        row[3, :3], row[4, :3] = group.tint, group.light_change
        to_group = np.linalg.inv(group.matrix)
        if view.parallel:
            row[5, :3] = to_group[:3, :3] @ to_world[:3, 2]  # towards the viewer; the line of sight is its negative
        else:
            row[5] = (*(to_group[:3, :3] @ to_world[:3, 3] + to_group[:3, 3]), 1)
    return texture(rows.reshape(-1, 4), shaders.POSE_TEXELS, "RGBA32F")
