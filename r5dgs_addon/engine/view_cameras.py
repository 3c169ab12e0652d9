"""Conversion of Blender cameras and 3D views to core cameras in Blender's world."""

from collections.abc import Callable
from dataclasses import dataclass

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.scene import cameras


@dataclass(frozen=True)
class ViewCamera:
    """Core camera and depth range of a view.

    Attributes:
        camera: Camera with OpenCV axes, in Blender's world.
        distance: Distance by which it is moved back from Blender's camera. Non-zero only for parallel projections,
            which are approximated from very far away; depths are larger by this value.
        near: Nearest rendered depth, or None for the scenes' own near plane.
    """

    camera: cameras.Camera
    distance: float = 0.0
    near: float | None = None


@dataclass(frozen=True)
class Eye:
    """Eye of a stereoscopic camera.

    Attributes:
        camera: The camera.
        matrix_world: Eye to world, with Blender's camera axes. [4, 4]
        shift_x: Total lens shift of camera and eye.
    """

    camera: bpy.types.Object
    matrix_world: np.ndarray
    shift_x: float


def of_camera(
    depsgraph: bpy.types.Depsgraph,
    points: Callable[[], np.ndarray],  # [P, 3]
    camera: bpy.types.Object | None = None,
    border: bool = True,
    eye: Eye | None = None,
) -> ViewCamera:
    """View of the image that Blender would render.

    Args:
        depsgraph: Depsgraph whose scene defines resolution, percentage, pixel aspect and border.
        points: Returns bounding points of the scene in Blender's world; called only for orthographic cameras.
        camera: Camera, or None for the scene's active one.
        border: True to crop the image to the render border.
        eye: Eye that replaces the camera.

    Returns:
        The view.

    Raises:
        ConfigError: There is no camera, or it is panoramic.
    """
    scene = depsgraph.scene
    if eye is not None:
        camera = eye.camera
    camera = scene.camera if camera is None else camera
    if camera is None or camera.type != "CAMERA":
        raise errors.ConfigError(f"{scene.name}: expected an active camera, found none; add one to the scene")
    if camera.data.type not in ("PERSP", "ORTHO"):
        raise errors.ConfigError(
            f"{camera.name}: expected a perspective or orthographic camera, found {camera.data.type.lower()}; set its "
            "lens type to Perspective"
        )
    width, height = size_of(scene)
    render = scene.render
    evaluated = camera.evaluated_get(depsgraph)
    projection = evaluated.calc_matrix_camera(
        depsgraph, x=width, y=height, scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y
    )
    world = evaluated.matrix_world
    if eye is not None:
        projection = np.array(projection, np.float64)
        shift = 2 * (eye.shift_x - evaluated.data.shift_x) * _fitted(camera.data, render, width, height) / width
        if cameras.is_parallel(projection):
            projection[0, 3] -= shift
        else:
            projection[0, 2] += shift
        world = eye.matrix_world
    view = _view(projection, world, width, height, points, camera.name, behind=False)
    if border and render.use_border:
        left, top, cut_width, cut_height = border_of(scene)
        return ViewCamera(cameras.crop(view.camera, left, top, cut_width, cut_height), view.distance, view.near)
    return view


def of_region(
    region: bpy.types.Region,
    region_3d: bpy.types.RegionView3D,
    points: Callable[[], np.ndarray],  # [P, 3]
) -> ViewCamera:
    """View of a 3D viewport.

    Args:
        region: Window region.
        region_3d: Its view and projection matrices.
        points: Returns bounding points of the scene in Blender's world; called only for orthographic views.

    Returns:
        The view.
    """
    world = region_3d.view_matrix.inverted()
    width, height = max(region.width, 1), max(region.height, 1)
    return _view(region_3d.window_matrix, world, width, height, points, "", behind=not region_3d.is_perspective)


def size_of(scene: bpy.types.Scene) -> tuple[int, int]:
    """Width and height of the full image that Blender would render, in pixels."""
    render = scene.render
    # Integer arithmetic, as in Blender: 100 * (29 / 100) is below 29 in floating point.
    return (
        max(render.resolution_x * render.resolution_percentage // 100, 1),
        max(render.resolution_y * render.resolution_percentage // 100, 1),
    )


def border_of(scene: bpy.types.Scene) -> tuple[int, int, int, int]:
    """Render border in pixels of the full image: left, top, width, height."""
    width, height = size_of(scene)
    render = scene.render
    left, right = int(render.border_min_x * width), int(render.border_max_x * width)
    bottom, top = int(render.border_min_y * height), int(render.border_max_y * height)
    return left, height - top, max(right - left, 1), max(top - bottom, 1)


def _fitted(camera: bpy.types.Camera, render: bpy.types.RenderSettings, width: int, height: int) -> float:
    """Pixels of a lens shift of 1: size of the image side that the sensor is fitted to."""
    across, up = render.pixel_aspect_x * width, render.pixel_aspect_y * height
    horizontal = camera.sensor_fit == "HORIZONTAL" or camera.sensor_fit == "AUTO" and across >= up
    return width if horizontal else up / render.pixel_aspect_x


def _view(projection, matrix_world, width: int, height: int, points: Callable, name: str, behind: bool) -> ViewCamera:
    p, world = np.array(projection, np.float64), np.array(matrix_world, np.float64)
    span = (0.0, 1.0)
    if cameras.is_parallel(p):
        forward = -world[:3, 2] / np.linalg.norm(world[:3, 2])
        depths = (points() - world[:3, 3]) @ forward
        span = (float(depths.min()), float(depths.max())) if len(depths) else span
    camera, distance = cameras.from_projection(p, world, width, height, span, name)
    # Orthographic cameras clip what is behind them; orthographic viewports do not.
    near = distance if distance and not behind else None
    return ViewCamera(camera, distance, near)
