"""What Blender shows, as a request to the worker, and the worker's picture as a Blender image.

The picture is display-referred sRGB, as trained. It is kept in an image of 8 bits per channel in the color space sRGB:
Blender shows such images as they are, saves the same bytes, and linearises them where the compositor needs it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ..r5dgs_core import errors
from ..r5dgs_core.scene import cameras
from . import objects, worker

IMAGE = "R5DGS Preview"


@dataclass(frozen=True)
class Shown:
    """What Blender shows of a loaded scene.

    Attributes:
        camera: The active camera, in the scene's world (that of the file, not Blender's).
        instances: One entry per visible point cloud: first row, rows, and the map of its bind state. [4, 4]
    """

    camera: cameras.Camera
    instances: list[tuple[int, int, np.ndarray]]


def preview(context: bpy.types.Context, collection: bpy.types.Collection) -> tuple[bpy.types.Image, float]:
    """Render what Blender shows into the image `R5DGS Preview`, and wait for it.

    Args:
        context: Its scene has the camera, the resolution and the frame.
        collection: A loaded scene.

    Returns:
        The image, and the milliseconds that the worker took to pose and rasterize.
    """
    seen = shown(context, collection)
    return finish(*render(collection, seen))


def start(context: bpy.types.Context, collection: bpy.types.Collection) -> worker.Job:
    """Begin a `preview` without waiting; give the job's answer to `finish`."""
    return worker.start(_steps(collection, shown(context, collection), (), True))


def finish(result: dict[str, Any], arrays: dict[str, np.ndarray]) -> tuple[bpy.types.Image, float]:
    """Put the worker's answer into the image `R5DGS Preview`; returns what `preview` does."""
    return write_image(IMAGE, arrays["color"]), result["ms_motion"] + result["ms_raster"]


def render(
    collection: bpy.types.Collection, seen: Shown, want: tuple[str, ...] = (), background: bool = True
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Have the worker render: its result and the arrays ``color`` [H, W, 3] and those wanted (alpha, depth, ids)."""
    answer: tuple[dict[str, Any], dict[str, np.ndarray]] = {}, {}
    for _, command, arguments in _steps(collection, seen, want, background):
        answer = worker.request(command, **arguments)
    return answer


def _steps(
    collection: bpy.types.Collection, seen: Shown, want: tuple[str, ...], background: bool
) -> list[tuple[str, str, dict[str, Any]]]:
    """The worker's requests for a picture; the last one's answer is the picture."""
    camera = seen.camera
    view = {
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "intrinsics": camera.intrinsics.tolist(),
            "T_cam_world": camera.T_cam_world.tolist(),
        },
        "instances": [{"start": s, "count": n, "matrix": m.tolist()} for s, n, m in seen.instances],
        "background": background,
        "want": list(want),
    }
    return [("loading the scene", "load", {"path": str(scene_path(collection))}), ("rendering", "render", view)]


def scene_path(collection: bpy.types.Collection) -> Path:
    """The file that a loaded scene came from; where it moved together with the .blend, the one beside that.

    Raises:
        SceneFileError: It is not there.
    """
    stored = Path(bpy.path.abspath(collection.r5dgs.filepath, library=collection.library))
    beside = Path(bpy.path.abspath("//")) / stored.name if bpy.data.filepath else stored
    for candidate in (stored, beside):
        if candidate.is_file():
            return candidate
    raise errors.SceneFileError(
        f"{stored}: expected the scene that '{collection.name}' was loaded from, found no file; choose its new place "
        "under 'Scene File' in the R5DGS tab"
    )


def shown(context: bpy.types.Context, collection: bpy.types.Collection) -> Shown:
    """What Blender shows of a loaded scene at the current frame, sub-frame included.

    Args:
        context: Its scene has the camera and the frame; what its view layer hides is left out.
        collection: A loaded scene.

    Returns:
        The camera and the visible clouds, in the coordinates of the scene's file.

    Raises:
        ConfigError: The camera or the root cannot be expressed.
    """
    depsgraph = context.evaluated_depsgraph_get()
    root = collection.r5dgs.root
    world = np.eye(4) if root is None else np.array(root.evaluated_get(depsgraph).matrix_world, np.float64)
    _check_root(collection, world)
    scene_world = np.linalg.inv(world)
    instances = []
    for cloud in objects.members(collection, "CLOUD"):
        if not cloud.visible_get(view_layer=context.view_layer):
            continue
        matrix = scene_world @ np.array(cloud.evaluated_get(depsgraph).matrix_world, np.float64)
        if np.linalg.matrix_rank(matrix[:3, :3], tol=1e-9) == 3:  # scaled to nothing: nothing to see
            instances.append((cloud.r5dgs.start, cloud.r5dgs.count, matrix))
    return Shown(_camera(context, depsgraph, scene_world), instances)


def _check_root(collection: bpy.types.Collection, world: np.ndarray) -> None:
    scales = np.linalg.svd(world[:3, :3], compute_uv=False)
    if scales[-1] <= 1e-9 or scales[0] - scales[-1] > 1e-4 * scales[0] or np.linalg.det(world[:3, :3]) < 0:
        raise errors.ConfigError(
            f"{collection.name}: expected the root empty to have one scale > 0 on all axes, found "
            f"{', '.join(f'{s:.4g}' for s in scales)}; scale the objects' anchors instead"
        )


def _camera(context: bpy.types.Context, depsgraph: bpy.types.Depsgraph, scene_world: np.ndarray) -> cameras.Camera:
    scene, camera = context.scene, context.scene.camera
    if camera is None or camera.type != "CAMERA":
        raise errors.ConfigError(f"{scene.name}: expected an active camera, found none; add one to the scene")
    if camera.data.type != "PERSP":
        raise errors.ConfigError(
            f"{camera.name}: expected a perspective camera, found {camera.data.type.lower()}; set its lens type to "
            "Perspective"
        )
    render_settings = scene.render
    # Whole numbers, as Blender does it: 100 * (29 / 100) is less than 29 in floating point.
    width = max(render_settings.resolution_x * render_settings.resolution_percentage // 100, 1)
    height = max(render_settings.resolution_y * render_settings.resolution_percentage // 100, 1)
    evaluated = camera.evaluated_get(depsgraph)
    projection = evaluated.calc_matrix_camera(
        depsgraph,
        x=width,
        y=height,
        scale_x=render_settings.pixel_aspect_x,
        scale_y=render_settings.pixel_aspect_y,
    )
    matrix = scene_world @ np.array(evaluated.matrix_world, np.float64)
    return cameras.Camera(
        width, height, intrinsics_of(projection, width, height), cameras.opengl_to_cam_world(matrix), camera.name
    )


def intrinsics_of(projection: Matrix, width: int, height: int) -> np.ndarray:
    """Camera matrix in pixels, OpenCV axes, of an OpenGL perspective projection; sensor fit and shift are in it.

    Args:
        projection: Camera space to clip space. [4, 4]
        width: Image width in pixels.
        height: Image height in pixels.

    Returns:
        The matrix. [3, 3]
    """
    p = np.array(projection, np.float64)
    return np.array(
        [
            [0.5 * width * p[0, 0], 0.0, 0.5 * width * (1 - p[0, 2])],
            [0.0, 0.5 * height * p[1, 1], 0.5 * height * (1 + p[1, 2])],
            [0.0, 0.0, 1.0],
        ]
    )


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
