"""Export of Blender's cameras as `transforms.json` or COLMAP text model."""

import re
from pathlib import Path

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.formats import camera_files
from ...r5dgs_core.formats.camera_files import CameraFrame
from ...r5dgs_core.playback import affine_transform
from ...r5dgs_core.scene import cameras
from ..engine import view_cameras, visible_clouds
from ..scene import loaded_scenes, timeline
from ..ui import plural
from ..ui.stepwise_operator import Outcome, Step, Steps
from . import frame_range, gaussians

FORMATS = (
    ("NERF", "transforms.json", "NeRF and D-NeRF: camera to world with OpenGL axes, lens and time"),
    ("COLMAP", "COLMAP Text", "cameras.txt, images.txt and an empty points3D.txt in sparse/0, times in times.json"),
)
WHICH = (
    ("ACTIVE", "Active Camera", "The scene's camera, and those that markers bind"),
    ("ALL", "All Cameras", "Every perspective camera of the scene"),
)


def steps(
    context: bpy.types.Context, folder: Path, which: str, *, format: str, axes: str, every: bool, step: int = 1
) -> Steps:
    """Write cameras into a folder; images are named ``images/frame_0001.png`` or ``images/CAMERA/0001.png``.

    Args:
        context: Context with the scene's cameras, frames and resolution.
        folder: Output folder, created if missing.
        which: Key of `WHICH`.
        format: Key of `FORMATS`.
        axes: Key of `gaussians.AXES`; "FILE" gives cameras in the data set's world.
        every: True for the scene's frame range, False for the current frame.
        step: Number of frames from one view to the next.

    Raises:
        ConfigError: There is no camera, or one cannot be exported.
        SceneFileError: A file cannot be written.
    """
    scene, found, notes = context.scene, [], []
    collection = loaded_scenes.active_collection(context)
    if axes == "FILE" and collection is None:
        raise errors.ConfigError("export: expected a loaded scene for the axes 'Scene File', found none; choose others")
    origin = loaded_scenes.origin(collection)
    if origin.any() and axes != "FILE":
        notes.append(gaussians.relative_note(origin, "the axes 'Scene File' give cameras of that world"))
    frames, folders = frame_range.frames_of(scene, every, step), _folders(scene)
    with frame_range.frame_kept(scene):
        for number, frame in enumerate(frames):
            yield Step(number, len(frames), f"frame {frame}")
            frame_range.go_to(scene, frame)
            depsgraph, t = context.evaluated_depsgraph_get(), time_of(scene, collection, frame, every)
            world = np.eye(4) if collection is None else visible_clouds.world_of(collection, depsgraph)
            for camera in _cameras(scene, which, notes):
                name = image_name(frame) if which == "ACTIVE" else f"images/{folders[camera]}/{frame:04d}.png"
                own = in_axes(depsgraph, camera, axes, world)
                found.append(CameraFrame(name, cameras.translated(own, origin) if axes == "FILE" else own, t))
    if not found:
        raise errors.ConfigError(f"{scene.name}: expected a camera, found none; add one to the scene")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if format == "NERF":
            written = camera_files.write_transforms(folder / "transforms.json", found)
        else:
            written = camera_files.write_colmap(folder, found)
    except OSError as error:
        raise errors.SceneFileError(f"{folder}: cannot be written: {error}") from error
    return Outcome(f"{written}: {plural.of(len(found), 'view')}", notes)


def image_name(frame: int) -> str:
    """Path of the active camera's image of a frame, relative to the folder."""
    return f"images/frame_{frame:04d}.png"


def _folders(scene: bpy.types.Scene) -> dict[bpy.types.Object, str]:
    """Unique folder name for each camera, valid on every file system and in COLMAP; duplicates are numbered."""
    found: dict[bpy.types.Object, str] = {}
    taken: set[str] = set()
    for camera in _sorted(scene):
        plain = re.sub(r"[^\w.+-]+", "_", camera.name)
        found[camera], number = plain, 1
        while found[camera].casefold() in taken:
            number += 1
            found[camera] = f"{plain}_{number}"
        taken.add(found[camera].casefold())
    return found


def _sorted(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Cameras of a Blender scene, sorted by name."""
    return sorted((obj for obj in scene.objects if obj.type == "CAMERA"), key=lambda obj: obj.name)


def time_of(scene: bpy.types.Scene, collection: bpy.types.Collection | None, frame: int, every: bool) -> float | None:
    """Scene time of a frame. Without a loaded scene: its fraction of the frame range, or None for a single frame."""
    if collection is not None:
        return timeline.of_collection(collection).time(frame)
    span = scene.frame_end - scene.frame_start
    return (frame - scene.frame_start) / span if every and span else None


def in_axes(depsgraph: bpy.types.Depsgraph, camera: bpy.types.Object, axes: str, world: np.ndarray) -> cameras.Camera:
    """Convert a Blender camera to other axes.

    Args:
        depsgraph: Evaluated depsgraph.
        camera: Perspective camera.
        axes: Key of `gaussians.AXES`.
        world: Transform from the loaded scene's own world to Blender's. [4, 4]

    Returns:
        Camera of the whole image, without render border.

    Raises:
        ConfigError: The scene's world is sheared or scaled unevenly, which a camera cannot express.
    """
    own = view_cameras.of_camera(depsgraph, lambda: np.zeros((0, 3)), camera, border=False).camera
    turn = gaussians.world_to(axes, world)
    if not affine_transform.is_similarity(turn[:3, :3]) or np.linalg.det(turn[:3, :3]) < 0:
        raise errors.ConfigError(
            "export: expected a root with uniform, positive scale, found another; choose other axes"
        )
    matrix = turn @ cameras.cam_world_to_opengl(own.T_cam_world)
    return cameras.Camera(own.width, own.height, own.intrinsics, cameras.opengl_to_cam_world(matrix), camera.name)


def _cameras(scene: bpy.types.Scene, which: str, notes: list[str]) -> list[bpy.types.Object]:
    """Cameras to export at the current frame."""
    if which == "ACTIVE":
        camera = scene.camera
        if camera is not None and camera.type == "CAMERA" and camera.data.type != "PERSP":
            raise errors.ConfigError(
                f"{camera.name}: expected a perspective camera, found {camera.data.type.lower()}; set its lens type to "
                "Perspective"
            )
        return [] if camera is None or camera.type != "CAMERA" else [camera]
    found = []
    for camera in _sorted(scene):
        if camera.data.type == "PERSP":
            found.append(camera)
        elif (note := f"{camera.name}: left out, as it is {camera.data.type.lower()}, not perspective") not in notes:
            notes.append(note)
    return found
