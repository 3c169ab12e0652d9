"""Captured images of a data set as backgrounds of the captured cameras, which follow the frame.

Each camera has one image in Blender, which stores the times and paths of all images of this camera. A frame change
handler replaces its path; that costs nothing until a view through the camera is drawn. The data set is a folder with
`transforms_*.json` files, which list the images of each camera, or with images named like the cameras: ``CAMERA.png``,
or a folder ``CAMERA`` of images in the order of time.
"""

import json
import math
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ...r5dgs_core import errors
from . import captured_cameras, loaded_scenes, object_names, timeline

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr")
OPACITY = 0.5
TIMES = "r5dgs_captured_images"  # custom property of an image: list of times and paths, as JSON


def show(collection: bpy.types.Collection, folder: str, frame: float) -> int:
    """Give each captured camera its images as background, and show the one nearest to a frame.

    Captured images shown before are replaced; other background images are kept.

    Args:
        collection: Loaded scene.
        folder: Folder of the data set; ``//`` is the folder of the .blend.
        frame: Frame of the timeline.

    Returns:
        Number of cameras with an image.

    Raises:
        ConfigError: There is no such folder, or no image of any camera in it.
    """
    home = Path(bpy.path.abspath(folder)).resolve()
    if not home.is_dir():
        raise errors.ConfigError(f"{home}: expected the folder of the data set, found none; choose another")
    cameras = captured_cameras.all_of(collection)
    times = timeline.of_collection(collection)
    named, t = _named_in_files(home), times.time(frame)
    shown = 0
    for camera in cameras:
        name = captured_cameras.name_of(camera)
        found = named.get(name) or _named_by_path(home, name, times.t_start, times.t_max)
        if not found:
            continue
        _remove(camera.data)
        image = bpy.data.images.load(str(_nearest(found, t)))
        image.name = object_names.fit(f"{camera.name} captured")
        image[TIMES] = json.dumps([(at, str(path)) for at, path in found])
        background = camera.data.background_images.new()
        background.image = image
        background.alpha, background.display_depth, background.frame_method = OPACITY, "FRONT", "FIT"
        camera.data.show_background_images = True
        shown += 1
    if not shown:
        raise errors.ConfigError(
            f"{home}: found no image of a captured camera such as '{captured_cameras.name_of(cameras[0])}'; choose "
            "the folder that the scene was trained on"
        )
    return shown


def follow(collection: bpy.types.Collection, frame: float) -> None:
    """Show the image nearest to a frame in each camera with captured images."""
    t = timeline.of_collection(collection).time(frame)
    for camera in captured_cameras.all_of(collection):
        for background in _backgrounds(camera.data):
            image = background.image
            path = str(_nearest(json.loads(image[TIMES]), t))
            if image.library is None and bpy.path.abspath(image.filepath) != path:
                image.filepath = path


@persistent
def _follow_frame(scene, *_):
    if bpy.app.is_job_running("RENDER"):
        return  # a view may be drawing the image while this runs in the thread of the render
    for collection in loaded_scenes.scene_collections():
        follow(collection, scene.frame_current_final)


def _nearest(images: list, t: float) -> str | Path:
    """Path of the image nearest to a time; of two equally near ones, the first by name."""
    return min(images, key=lambda one: (abs(one[0] - t), one[1]))[1]


def _backgrounds(data: bpy.types.Camera) -> list[bpy.types.CameraBackgroundImage]:
    """Backgrounds of a camera that show captured images."""
    return [one for one in data.background_images if one.image is not None and TIMES in one.image]


def _remove(data: bpy.types.Camera) -> None:
    """Remove the captured images of a camera."""
    for background in _backgrounds(data):
        image = background.image
        background.image = None  # removing the background alone does not decrement the users of the image
        data.background_images.remove(background)
        if not image.users:
            bpy.data.images.remove(image)


def _named_in_files(folder: Path) -> dict[str, list[tuple[float, Path]]]:
    """Time and path of the images that the files of a data set list, by camera."""
    found: dict[str, list[tuple[float, Path]]] = {}
    for file in sorted(folder.glob("transforms*.json")):
        try:
            listed = _listed(json.loads(file.read_text(encoding="utf-8")))
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue  # not a data set's file
        for names, given, t in listed:
            path = _image(folder, given)
            if path is None or not math.isfinite(t):
                continue
            for name in names - {""}:
                found.setdefault(name, []).append((t, path))
    return found


def _listed(content: dict) -> list[tuple[set[str], str, float]]:
    """Names of the camera, path and time of each image that a file lists, by camera (``data``) or in one list."""
    if "data" in content:
        frames = [({str(name)}, one) for name, camera in content["data"].items() for one in camera["frames"]]
    else:
        frames = [
            ({str(one.get("view", one.get("camera", ""))), Path(str(one["file_path"])).stem}, one)
            for one in content["frames"]
        ]
    return [(names, str(one["file_path"]), float(one.get("time", 0.0))) for names, one in frames]


def _image(folder: Path, given: str) -> Path | None:
    """Image inside a folder, with or without its suffix, or None."""
    place = (folder / given).resolve()
    if not place.is_relative_to(folder.resolve()):
        return None
    every = [place, *(place.with_name(place.name + suffix) for suffix in SUFFIXES)]
    return next((path for path in every if path.suffix.lower() in SUFFIXES and path.is_file()), None)


def _named_by_path(folder: Path, name: str, first: float, last: float) -> list[tuple[float, Path]]:
    """Time and path of the images whose file or folder is named like a camera."""
    for home in (folder / "images", folder):
        alone = _image(home, name)
        if alone is not None:
            return [(first, alone)]
        inside = (home / name).resolve()
        if inside.is_dir() and inside.is_relative_to(folder.resolve()):
            files = sorted(path for path in inside.iterdir() if path.suffix.lower() in SUFFIXES)
            step = (last - first) / max(len(files) - 1, 1)
            return [(first + number * step, path) for number, path in enumerate(files)]
    return []


def register():
    """Register the handler."""
    bpy.app.handlers.frame_change_post.append(_follow_frame)


def unregister():
    """Undo `register`."""
    if _follow_frame in bpy.app.handlers.frame_change_post:
        bpy.app.handlers.frame_change_post.remove(_follow_frame)
