"""What Blender shows, as a request to the worker, and the worker's picture as a Blender image.

All loaded scenes of the active Blender scene are in one picture, in Blender's world. The picture is display-referred
sRGB, as trained. It is kept in an image of 8 bits per channel in the color space sRGB: Blender shows such images as
they are, saves the same bytes, and linearises them where the compositor needs it.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.scene import cameras
from ..scene import trust
from ..worker import jobs
from . import render_stats, view_cameras, visible_clouds

IMAGE = "R5DGS Preview"
PREVIEW = "preview"  # what `jobs.busy` knows previews by


@dataclass(frozen=True)
class Shown:
    """What Blender shows of its loaded scenes.

    Attributes:
        view: What looks, in Blender's world.
        scenes: Collections of the loaded scenes that can be seen; instances number them.
        worlds: Map of each scene's world to Blender's. [4, 4] each
        instances: Visible clouds and instances of them.
    """

    view: view_cameras.View
    scenes: tuple[bpy.types.Collection, ...]
    worlds: tuple[np.ndarray, ...]
    instances: tuple[visible_clouds.Instance, ...]

    @property
    def camera(self) -> cameras.Camera:
        """The camera, in Blender's world, OpenCV axes."""
        return self.view.camera


def shown(
    depsgraph: bpy.types.Depsgraph,
    looks: Callable[[Callable[[], np.ndarray]], view_cameras.View] | None = None,
    space: bpy.types.SpaceView3D | None = None,
) -> Shown:
    """What Blender shows of its loaded scenes at the evaluated frame, sub-frame included.

    Args:
        depsgraph: Evaluated; one of a viewport hides what viewports hide, one of a render what renders hide.
        looks: Gives what looks, of `view_cameras`, of points around what is seen; the active camera where None.
        space: A 3D view whose local view hides the rest.

    Returns:
        View, scenes and instances.

    Raises:
        ConfigError: The camera cannot be expressed, or a cloud has lost its points.
    """
    scenes, instances = visible_clouds.instances(depsgraph, space)
    instances = tuple(one for one in instances if one.seen)
    points = visible_clouds.points(instances)
    view = view_cameras.of_camera(depsgraph, points) if looks is None else looks(points)
    return Shown(view, scenes, tuple(visible_clouds.world_of(one, depsgraph) for one in scenes), instances)


def render(seen: Shown, want: tuple[str, ...] = (), sky: bool = True) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Have the worker render, and wait for it.

    Args:
        seen: What `shown` gave.
        want: Any of ``depth alpha owners``. With hold-outs, ``holdout`` comes, too.
        sky: Whether the first scene's sky lies behind everything, or black.

    Returns:
        The result, with ``ms_motion``, ``ms_raster`` and ``gaussians``, and arrays, top row first: ``color``, display-
        referred sRGB over the sky or, without one, multiplied by alpha [H, W, 3]; ``alpha`` [H, W]; ``depth``, expected
        z in the camera frame divided by alpha, 0 where alpha is 0 [H, W]; ``owners``, which of ``seen.instances`` has
        the largest share of the pixel, -1 where alpha is below a half [H, W] int32; ``holdout``, the coverage of
        hold-outs, which are black and part of nothing else [H, W].

    Raises:
        R5dgsError: What the worker reports.
    """
    return jobs.run(steps(seen, want, sky))


def steps(seen: Shown, want: tuple[str, ...] = (), sky: bool = True) -> list[tuple[str, str, dict[str, Any]]]:
    """The worker's requests for a picture, as `jobs.start` takes them; the job's answer is what `render` returns."""
    picture = {
        "camera": seen.view.request(),
        "instances": [instance.request() for instance in seen.instances],
        "sky": {"scene": 0, "matrix": seen.worlds[0].tolist()} if sky and seen.scenes else None,
        "near": seen.view.near,
        "distance": seen.view.distance,
        "want": [*want, *(["holdout"] if any(one.holdout for one in seen.instances) else [])],
    }
    paths = [str(scene_path(collection)) for collection in seen.scenes]
    edits = tuple(dict.fromkeys(one.edit for one in seen.instances if one.edit is not None))
    edited = [("handing over edited points", "points", {"points": edits})] if edits else []
    return [("loading the scenes", "load", {"paths": paths}), *edited, ("rendering", "render", picture)]


def scene_path(collection: bpy.types.Collection) -> Path:
    """The file that a loaded scene came from, see `trust.find`.

    Raises:
        SceneFileError: It is missing, or the user has to allow it first.
    """
    found = trust.find(collection)
    if found.path is not None:
        return found.path
    if found.asked is not None:
        raise errors.SceneFileError(
            f"{found.asked}: not read, as it lies neither beside nor below the .blend that names it; "
            "press Allow in the panel Scene of the R5DGS tab, or add its folder to 'Trusted Folders' in the add-on's "
            f"preferences or to the environment variable {trust.ENVIRONMENT}"
        )
    raise errors.SceneFileError(
        f"{os.path.normpath(trust.places(collection)[0])}: expected the scene that '{collection.name}' was loaded "
        "from, found no file; choose its new place under 'Scene File' in the R5DGS tab"
    )


def start(context: bpy.types.Context) -> jobs.Job:
    """Begin a picture of what Blender shows without waiting; give the job's answer to `finish`."""
    return jobs.submit(PREVIEW, steps(shown(context.evaluated_depsgraph_get())))


def finish(answer: tuple[dict[str, Any], dict[str, np.ndarray]]) -> tuple[bpy.types.Image, dict[str, Any]]:
    """Put the worker's answer into the image `R5DGS Preview`, and its figures where the sidebar shows them.

    Returns:
        The image, and the result: ``ms_motion ms_raster gaussians``, and ``name error unbent`` for each of ``scenes``.
    """
    result, arrays = answer
    image = write_image(IMAGE, arrays["color"])
    render_stats.remember(image, result)
    return image, result


def show(context: bpy.types.Context, image: bpy.types.Image) -> bool:
    """Put an image into Image Editors that hold none; whether one shows it, or there is no window to look at."""
    if bpy.app.background:
        return True
    areas = [area for window in context.window_manager.windows for area in window.screen.areas]
    spaces = [area.spaces.active for area in areas if area.type == "IMAGE_EDITOR"]
    for space in spaces:
        if space.image is None:
            space.image = image
    return any(space.image == image for space in spaces)


def write_image(name: str, color: np.ndarray) -> bpy.types.Image:
    """Put a display-referred picture into a Blender image of 8 bits per channel, made where it does not exist.

    Args:
        name: Name of the image.
        color: sRGB, clamped to [0, 1] here, top row first. [H, W, 3]

    Returns:
        The image.
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
