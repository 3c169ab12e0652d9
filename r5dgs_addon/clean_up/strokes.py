"""Selection of Gaussians by a stroke of the lasso or brush in a 3D view."""

from collections.abc import Iterator
from dataclasses import dataclass

import bpy
import numpy as np

from ..scene import point_clouds
from . import selected_points, view_selection

DEPTHS = (
    ("FRONT", "Front Only", "Gaussians that are not hidden by others"),
    ("THROUGH", "Through", "Gaussians at any depth"),
)


@dataclass(frozen=True)
class StrokeView:
    """View in which a stroke is drawn.

    Attributes:
        matrix: From Blender's world to clip space. [4, 4]
        width: Width of the region in pixels.
        height: Height of the region in pixels.
        space: 3D view whose local view is respected, or None.
    """

    matrix: np.ndarray
    width: int
    height: int
    space: bpy.types.SpaceView3D | None = None

    @staticmethod
    def of(context: bpy.types.Context) -> "StrokeView":
        """View of the 3D view in a context."""
        region = context.region
        matrix = np.array(context.region_data.perspective_matrix, np.float64)
        return StrokeView(matrix, region.width, region.height, context.space_data)


@dataclass(frozen=True)
class Stroke:
    """A stroke.

    Attributes:
        path: Places in pixels from the lower left corner of the region. [k, 2]
        radius: Radius of the brush in pixels, or None for a lasso.
        front: True to leave out Gaussians behind others.
    """

    path: np.ndarray
    radius: float | None
    front: bool


def select(
    context: bpy.types.Context, collection: bpy.types.Collection, view: StrokeView, stroke: Stroke, mode: str
) -> int:
    """Select the visible Gaussians of a loaded scene whose centres a stroke covers.

    Args:
        context: Context with the current frame.
        collection: Loaded scene.
        view: StrokeView of the stroke.
        stroke: The stroke.
        mode: Key of `selected_points.MODES`.

    Returns:
        Number of selected Gaussians afterwards.

    Raises:
        ConfigError: A cloud cannot be edited.
    """

    def masks(members: list[bpy.types.Object]) -> Iterator[np.ndarray]:
        shown = [cloud.visible_get(view_layer=context.view_layer, viewport=view.space) for cloud in members]
        seen = [_seen(context, cloud, view) for cloud, there in zip(members, shown, strict=True) if there]
        if not seen:
            yield from (np.zeros(len(cloud.data.points), bool) for cloud in members)
            return
        pixels, depths, w = (np.concatenate(columns) for columns in zip(*seen, strict=True))
        if stroke.radius is None:
            covered = view_selection.in_lasso(pixels, stroke.path)
        else:
            covered = view_selection.under_brush(pixels, stroke.path, stroke.radius)
        if stroke.front:
            there = [cloud for cloud, is_shown in zip(members, shown, strict=True) if is_shown]
            covered &= _front(context, there, view, pixels, depths, w, covered)
        parts = iter(np.split(covered, np.cumsum([len(one[0]) for one in seen])[:-1]))
        for cloud, there in zip(members, shown, strict=True):
            yield next(parts) if there else np.zeros(len(cloud.data.points), bool)

    return selected_points.select(collection, mode, masks)


def _matrix(context: bpy.types.Context, cloud: bpy.types.Object) -> np.ndarray:
    """World matrix of a cloud. [4, 4]"""
    return np.array(cloud.evaluated_get(context.evaluated_depsgraph_get()).matrix_world, np.float64)


def _seen(context: bpy.types.Context, cloud: bpy.types.Object, view: StrokeView) -> tuple[np.ndarray, ...]:
    """Pixels, depths and homogeneous coordinates of the points of a cloud. [n, 2], [n], [n]"""
    position = point_clouds.attribute(cloud.data, "position", "FLOAT_VECTOR")
    places = point_clouds.view(position, "vector", 3)
    return view_selection.project(places, view.matrix @ _matrix(context, cloud), view.width, view.height)


def _front(
    context: bpy.types.Context,
    members: list[bpy.types.Object],
    view: StrokeView,
    pixels: np.ndarray,
    depths: np.ndarray,
    w: np.ndarray,
    covered: np.ndarray,
) -> np.ndarray:
    """Mask of the covered Gaussians that others do not hide. [n]"""
    result = np.zeros(len(pixels), bool)
    if not covered.any():
        return result
    low, high = pixels[covered].min(0), pixels[covered].max(0)
    near = np.flatnonzero(view_selection.within(pixels, low - 16, high + 16))
    looks = [_look(cloud.data, _matrix(context, cloud)) for cloud in members]
    opacities, sizes = (np.concatenate(columns)[near] for columns in zip(*looks, strict=True))
    scale = 0.5 * view.height * float(np.linalg.norm(view.matrix[1, :3]))
    result[near] = view_selection.is_in_front(pixels[near], depths[near], opacities, scale * sizes / w[near])
    return result


def _look(data: bpy.types.PointCloud, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Opacities and root mean square standard deviations in Blender's world of the points of a cloud. [n], [n]"""
    base = point_clouds.attribute(data, "radiance:base", "FLOAT_COLOR")
    scale = point_clouds.attribute(data, "scale", "FLOAT_VECTOR")
    count, stretch = len(data.points), abs(np.linalg.det(matrix[:3, :3])) ** (1 / 3)
    opacities = np.ones(count) if base is None else point_clouds.view(base, "color", 4)[:, 3].astype(np.float64)
    if scale is None:
        return opacities, np.zeros(count)
    return opacities, stretch * np.sqrt(
        np.square(point_clouds.view(scale, "vector", 3)) @ np.full(3, 1 / 3, np.float32)
    )
