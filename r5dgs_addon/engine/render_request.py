"""Worker request for the current state of the Blender scene, and conversion of the result to a Blender image.

All loaded scenes of the active Blender scene are rendered into one image, in Blender's world. The image is
display-referred sRGB, as trained. It is stored with 8 bits per channel in the color space sRGB: Blender displays and
saves such images unchanged, and linearises them for the compositor.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.protocol.messages import RenderRequest
from ...r5dgs_core.scene import cameras
from ...r5dgs_core.scene.instance import Sky
from ..scene import trust
from ..worker import jobs
from . import render_stats, view_cameras, visible_clouds

IMAGE = "R5DGS Preview"
PREVIEW = "preview"  # job key for `jobs.busy`


@dataclass(frozen=True)
class VisibleParts:
    """Visible parts of the loaded scenes.

    Attributes:
        view: View to render, in Blender's world.
        scenes: Collections of the visible loaded scenes, indexed by the instances.
        worlds: Transform of each scene's world to Blender's. [4, 4] each
        instances: Visible point clouds and instances of them.
    """

    view: view_cameras.ViewCamera
    scenes: tuple[bpy.types.Collection, ...]
    worlds: tuple[np.ndarray, ...]
    instances: tuple[visible_clouds.VisibleCloud, ...]

    @property
    def camera(self) -> cameras.Camera:
        """Camera in Blender's world, OpenCV axes."""
        return self.view.camera


def shown(
    depsgraph: bpy.types.Depsgraph,
    looks: Callable[[Callable[[], np.ndarray]], view_cameras.ViewCamera] | None = None,
    space: bpy.types.SpaceView3D | None = None,
) -> VisibleParts:
    """Visible parts of the loaded scenes at the evaluated frame, sub-frame included.

    Args:
        depsgraph: Evaluated depsgraph; its mode decides between viewport and render visibility.
        looks: Function of `view_cameras` that maps a getter of bounding points to the view; None for the active camera.
        space: 3D view whose local view is respected.

    Returns:
        View, scenes and instances.

    Raises:
        ConfigError: The camera is unsupported, or a point cloud has lost its points.
    """
    scenes, instances = visible_clouds.instances(depsgraph, space)
    instances = tuple(one for one in instances if one.seen)
    points = visible_clouds.points(instances)
    view = view_cameras.of_camera(depsgraph, points) if looks is None else looks(points)
    return VisibleParts(view, scenes, tuple(visible_clouds.world_of(one, depsgraph) for one in scenes), instances)


def render(
    seen: VisibleParts, want: tuple[str, ...] = (), sky: bool = True
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Render in the worker and wait for the result.

    Args:
        seen: Result of `shown`.
        want: Any of ``depth alpha owners``. With hold-outs, ``holdout`` is added.
        sky: True to draw the first scene's sky as background instead of black.

    Returns:
        The result with ``ms_motion``, ``ms_raster`` and ``gaussians``, and arrays, top row first: ``color``,
        display-referred sRGB over the sky or, without sky, premultiplied by alpha [H, W, 3]; ``alpha`` [H, W];
        ``depth``,
        expected z in the camera frame divided by alpha, 0 if alpha is 0 [H, W]; ``owners``, index into
        ``seen.instances`` of the instance with the largest share of the pixel, -1 if alpha is below 0.5 [H, W] int32;
        ``holdout``, coverage of hold-outs, which are black and contribute to no other array [H, W].

    Raises:
        R5dgsError: Error reported by the worker.
    """
    return jobs.run(steps(seen, want, sky))


def steps(seen: VisibleParts, want: tuple[str, ...] = (), sky: bool = True) -> list[tuple[str, str, dict[str, Any]]]:
    """Worker requests of an image, for `jobs.start`. The job returns the same as `render`."""
    held = any(one.holdout for one in seen.instances)
    picture = RenderRequest(
        seen.camera,
        seen.instances,
        tuple(None if one.edit is None else one.edit.key for one in seen.instances),
        sky=Sky(0, seen.worlds[0]) if sky and seen.scenes else None,
        near=seen.view.near,
        distance=seen.view.distance,
        want=(*want, "holdout") if held else want,
    )
    paths = [str(scene_path(collection)) for collection in seen.scenes]
    edits = tuple(dict.fromkeys(one.edit for one in seen.instances if one.edit is not None))
    edited = [("handing over edited points", "points", {"points": edits})] if edits else []
    return [("loading the scenes", "load", {"paths": paths}), *edited, ("rendering", "render", picture.to_json())]


def scene_path(collection: bpy.types.Collection) -> Path:
    """File of a loaded scene, see `trust.find`.

    Raises:
        SceneFileError: The file is missing, or the user must allow it first.
    """
    found = trust.find(collection)
    if found.path is not None:
        return found.path
    if found.asked is not None:
        raise errors.SceneFileError(
            f"{found.asked}: not read, because it is outside the folder of the .blend that uses it; "
            "press Allow in the panel Scene of the R5DGS tab, or add its folder to 'Trusted Folders' in the "
            f"preferences or to the environment variable {trust.ENVIRONMENT}"
        )
    raise errors.SceneFileError(
        f"{os.path.normpath(trust.places(collection)[0])}: expected the scene that '{collection.name}' was loaded "
        "from, found no file; choose its new place under 'Scene File' in the R5DGS tab"
    )


def start(context: bpy.types.Context) -> jobs.Job:
    """Submit a preview of the current scene without waiting. Pass the job's result to `finish`."""
    return jobs.submit(PREVIEW, steps(shown(context.evaluated_depsgraph_get())))


def finish(answer: tuple[dict[str, Any], dict[str, np.ndarray]]) -> tuple[bpy.types.Image, dict[str, Any]]:
    """Write the worker's result to the image `R5DGS Preview` and its statistics to the sidebar.

    Returns:
        The image, and the result: ``ms_motion ms_raster gaussians``, and ``name error unbent`` for each of ``scenes``.
    """
    result, arrays = answer
    image = write_image(IMAGE, arrays["color"])
    render_stats.remember(image, result)
    return image, result


def show(context: bpy.types.Context, image: bpy.types.Image) -> bool:
    """Show an image in empty Image Editors. Returns True if an editor shows it, or in background mode."""
    if bpy.app.background:
        return True
    areas = [area for window in context.window_manager.windows for area in window.screen.areas]
    spaces = [area.spaces.active for area in areas if area.type == "IMAGE_EDITOR"]
    for space in spaces:
        if space.image is None:
            space.image = image
    return any(space.image == image for space in spaces)


def write_image(name: str, color: np.ndarray) -> bpy.types.Image:
    """Write a display-referred image to a Blender image with 8 bits per channel, which is created if missing.

    Args:
        name: Name of the image.
        color: sRGB, clamped to [0, 1] here, top row first. [H, W, 3]

    Returns:
        The Blender image.
    """
    height, width = color.shape[:2]
    image = bpy.data.images.get(name)
    if image is not None and (image.is_float or image.source != "GENERATED"):
        bpy.data.images.remove(image)
        image = None
    if image is None:
        image = bpy.data.images.new(name, width, height, alpha=False, float_buffer=False)
    image.colorspace_settings.name = "sRGB"
    if tuple(image.size) != (width, height):
        image.scale(width, height)
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = np.clip(color[::-1], 0.0, 1.0)
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    return image
