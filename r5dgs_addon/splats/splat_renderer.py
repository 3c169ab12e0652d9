"""Splats of several groups of Gaussians, drawn into an offscreen buffer."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass

import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ...r5dgs_core import errors
from ...r5dgs_core.scene import cameras
from . import gaussian_table, shaders
from .depth_order import DepthOrder

SLACK = 0.3  # the rasterizer's `frustum_slack`
LARGEST = 1e15  # entry of a matrix to the camera; larger ones overflow in the shader
EXACT = 1 << 24  # integers that a float32 holds
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
        light: Direction of the light. [3]
        holdout: True if the group cuts a hole into everything behind it.
    """

    number: int
    matrix: np.ndarray
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    light_change: tuple[float, float, float] = (0.0, 0.0, 0.0)
    light: tuple[float, float, float] = (0.0, 0.0, 0.0)
    holdout: bool = False


@dataclass(frozen=True)
class ViewMatrices:
    """View of a picture.

    Attributes:
        view_matrix: Blender's world to the camera, looking along -z. [4, 4]
        projection: Camera to clip space, OpenGL. [4, 4]
        width: Pixels.
        height: Pixels.
    """

    view_matrix: np.ndarray
    projection: np.ndarray
    width: int
    height: int

    @property
    def parallel(self) -> bool:
        """True if the view is orthographic."""
        return cameras.is_parallel(self.projection)

    @property
    def near(self) -> float:
        """Depth of the near plane, below which a perspective view culls Gaussians."""
        p = self.projection
        return 0.0 if self.parallel else float(p[2, 3] / (p[2, 2] - 1))


def matrix(values: np.ndarray) -> Matrix:
    """Convert an array to a matrix of Blender. [4, 4]"""
    return Matrix(values.tolist())


def texture(values: np.ndarray, width: int, format: str) -> gpu.types.GPUTexture:
    """Create a texture with rows of ``width`` texels; the last row is padded with zeros. [n] or [n, 4]"""
    channels = values.shape[1] if values.ndim > 1 else 1
    height = max(-(-len(values) // width), 1)
    flat = values.ravel()
    if flat.dtype != np.float32 or len(flat) != width * height * channels:
        flat = np.zeros(width * height * channels, np.float32)
        flat[: values.size] = values.ravel()
    return gpu.types.GPUTexture((width, height), format=format, data=gpu.types.Buffer("FLOAT", len(flat), flat))


class SplatTable:
    """Textures of the Gaussians of all groups.

    Args:
        table: The Gaussians.

    Raises:
        ConfigError: There are more Gaussians or groups than the textures hold.
    """

    def __init__(self, table: gaussian_table.Table):
        self.starts, self.positions = table.starts, table.positions
        self.versions = [0] * (len(table.starts) - 1)  # how often each group was moved
        count, texels = table.looks.shape[:2]
        width = shaders.width()
        holds = min(width // max(texels, gaussian_table.GEOMETRY) * width, EXACT)
        if count > holds or len(self.starts) > width // shaders.POSE_TEXELS * width:
            raise errors.ConfigError(
                f"{count} Gaussians in {len(self.starts) - 1} clouds: expected at most {holds} as splats, which the "
                "textures of this graphics card hold; hide objects, or show a scene as points"
            )
        self.shader = _shader(table.degree, table.shaded, table.turned, texels)
        self.quads = batch_for_shader(self.shader, "TRI_STRIP", CORNERS)
        self.looks = texture(table.looks.reshape(-1, 4), width // texels * texels, "RGBA32F")
        wide = width // gaussian_table.GEOMETRY
        padded = np.zeros((max(-(-count // wide), 1) * wide, gaussian_table.GEOMETRY, 4), np.float32)
        padded[:count] = table.geometry
        none = np.zeros((0, *table.looks.shape[1:]), np.float32)  # not a slice, which would keep all looks in memory
        self._table = dataclasses.replace(table, geometry=padded, looks=none)
        self._geometry: gpu.types.GPUTexture | None = None

    def move(self, group: int, geometry: gaussian_table.Geometry) -> None:
        """Change the geometry of a group; the number of its Gaussians stays the same."""
        self._table.move(group, geometry)
        self.versions[group] += 1
        self._geometry = None

    @property
    def geometry(self) -> gpu.types.GPUTexture:
        """Texture of the geometry, a new one after each `move`, because textures cannot be changed."""
        if self._geometry is None:
            width = shaders.width() // gaussian_table.GEOMETRY * gaussian_table.GEOMETRY
            self._geometry = texture(self._table.geometry.reshape(-1, 4), width, "RGBA32F")
        return self._geometry


class SplatBuffer:
    """Picture of splats for one view: display-referred colors, premultiplied, and coverage. Kept until drawn again."""

    def __init__(self):
        self._picture: gpu.types.GPUOffScreen | None = None
        self._holes: gpu.types.GPUOffScreen | None = None
        self._table: SplatTable | None = None
        self._order: DepthOrder | None = None
        self._rows: np.ndarray | None = None
        self._rows_texture: gpu.types.GPUTexture | None = None
        self._poses: list[gpu.types.GPUTexture] = []  # keeps the textures alive until the picture is drawn

    @property
    def texture(self) -> gpu.types.GPUTexture:
        """Texture of the picture."""
        return self._picture.texture_color

    @property
    def holes(self) -> gpu.types.GPUTexture | None:
        """Texture whose red channel is the visible share of hold-outs, or None if there are none."""
        return None if self._holes is None else self._holes.texture_color

    def draw(
        self, table: SplatTable, groups: Sequence[Group], view: ViewMatrices, meshes: gpu.types.GPUTexture | None = None
    ) -> None:
        """Draw groups of a table. Those with values that are too large or not finite are left out.

        Args:
            table: The Gaussians.
            groups: Visible groups, each at most once.
            view: The view.
            meshes: Depth buffer of the solid geometry, as large as the picture; None if there is none.
        """
        groups = [group for group in groups if _is_drawable(group, view)]
        rows = self._sorted(table, groups, view)
        self._picture = target(self._picture, view)
        self._poses = [_poses(groups, len(table.starts) - 1, view)]
        self._draw(self._picture, self._poses[0], table, view, meshes, len(rows))
        if any(group.holdout for group in groups):
            self._holes = target(self._holes, view)
            self._poses.append(_poses(groups, len(table.starts) - 1, view, holes=True))
            self._draw(self._holes, self._poses[1], table, view, meshes, len(rows))
        else:
            self._holes = None

    def _sorted(self, table: SplatTable, groups: Sequence[Group], view: ViewMatrices) -> np.ndarray:
        """Rows of the visible Gaussians, from far to near, as an array and as a texture."""
        if self._table is not table or self._order is None:
            self._table, self._order, self._rows = table, DepthOrder(table.positions, table.starts), None
        planes = {group.number: -(view.view_matrix @ group.matrix)[2] for group in groups}
        versions = {group.number: table.versions[group.number] for group in groups}
        rows = self._order.update(planes, view.near, view.parallel, versions)
        if rows is not self._rows:
            self._rows = rows
            self._rows_texture = texture(rows.astype(np.float32), shaders.width(), "R32F")
        return rows

    def _draw(
        self,
        picture: gpu.types.GPUOffScreen,
        poses: gpu.types.GPUTexture,
        table: SplatTable,
        view: ViewMatrices,
        meshes: gpu.types.GPUTexture | None,
        count: int,
    ) -> None:
        with picture.bind():
            gpu.state.active_framebuffer_get().clear(color=(0.0, 0.0, 0.0, 0.0))
            if not count:
                return
            shader = table.shader
            gpu.state.depth_test_set("NONE")
            gpu.state.depth_mask_set(False)
            gpu.state.blend_set("ALPHA_PREMULT")
            shader.bind()
            shader.uniform_float("projection", matrix(view.projection))
            shader.uniform_float("view", (view.width, view.height, view.near, float(meshes is not None)))
            shader.uniform_float("slopes", _slopes(view.projection))
            shader.uniform_sampler("geometry", table.geometry)
            shader.uniform_sampler("looks", table.looks)
            shader.uniform_sampler("poses", poses)
            shader.uniform_sampler("order", self._rows_texture)
            shader.uniform_sampler("meshes", meshes or nothing())
            table.quads.draw_instanced(shader, instance_count=count)
            gpu.state.blend_set("NONE")


def target(known: gpu.types.GPUOffScreen | None, view: ViewMatrices) -> gpu.types.GPUOffScreen:
    """Return a buffer of the size of a view, the known one if possible."""
    size = (view.width, view.height)
    if known is not None and (known.width, known.height) == size:
        return known
    return gpu.types.GPUOffScreen(*size, format="RGBA32F")


def _is_drawable(group: Group, view: ViewMatrices) -> bool:
    to_camera = view.view_matrix @ group.matrix
    return bool(np.abs(to_camera).max() < LARGEST and np.isfinite((*group.tint, *group.light_change)).all())


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


def _poses(groups: Sequence[Group], count: int, view: ViewMatrices, holes: bool = False) -> gpu.types.GPUTexture:
    """Texture with the data of each group for the shader.

    With ``holes``, hold-outs are white and the others black; otherwise hold-outs are black.
    """
    rows = np.zeros((count, shaders.POSE_TEXELS, 4), np.float32)
    to_world = np.linalg.inv(view.view_matrix)
    for group in groups:
        row = rows[group.number]
        row[:3] = (view.view_matrix @ group.matrix)[:3]
        row[3] = (*group.tint, 0.0)
        if holes or group.holdout:
            row[3] = (*[float(holes and group.holdout)] * 3, 1.0)
        row[4, :3], row[6, :3] = group.light_change, group.light
        to_group = np.linalg.inv(group.matrix)
        if view.parallel:
            row[5, :3] = to_group[:3, :3] @ to_world[:3, 2]  # towards the viewer; the line of sight is its negative
        else:
            row[5] = (*(to_group[:3, :3] @ to_world[:3, 3] + to_group[:3, 3]), 1)
    return texture(rows.reshape(-1, 4), shaders.width() // shaders.POSE_TEXELS * shaders.POSE_TEXELS, "RGBA32F")
