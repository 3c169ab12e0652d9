"""View of a loaded scene from its best captured camera, in all 3D views."""

import bpy
import numpy as np
from mathutils import Matrix

from ...r5dgs_core.scene import cameras
from ...r5dgs_core.scene.scene import Scene
from . import loaded_scenes

SAMPLE = 2000  # number of Gaussians by which the best camera is chosen
NEAREST, FARTHEST = 1e-3, 100.0  # clip range as factors of the distance to the objects
DEFAULT_CLIP = (0.01, 1000.0)  # Blender's own, which is only widened
VIEW_SENSOR_MM = 72.0  # width that the focal length of a 3D view refers to, on the longer side of its region
LENSES_MM = (1.0, 250.0)  # of 3D views


def remember(collection: bpy.types.Collection, scene: Scene) -> None:
    """Store the view of the best captured camera and the distance to the objects; nothing if there are no cameras."""
    if scene.cameras:
        camera = scene.cameras[best(scene)]
        pose, k = cameras.cam_world_to_opengl(camera.T_cam_world), camera.intrinsics
        size = camera.width / k[0, 0], camera.height / k[1, 1]
        collection[loaded_scenes.VIEW] = [*pose.ravel().tolist(), distance(scene, camera), *map(float, size)]


def best(scene: Scene) -> int:
    """Index of the captured camera that sees the objects best. The scene has cameras."""
    points = _points(scene)
    scores = [_score(camera, points) for camera in scene.cameras]
    return scores.index(max(scores))


def distance(scene: Scene, camera: cameras.Camera) -> float:
    """Median depth of the objects in front of a camera, or the scene's extent if there are none."""
    depths = (_points(scene) - camera.center) @ camera.forward
    return float(np.median(depths[depths > 0])) if (depths > 0).any() else scene.extent


def clip_range(distance: float) -> tuple[float, float]:
    """Return a clip range for objects at a distance, which includes Blender's default range."""
    start = min(max(NEAREST * distance, 1e-6), DEFAULT_CLIP[0])
    return start, max(FARTHEST * distance, DEFAULT_CLIP[1])


def show(context: bpy.types.Context, collection: bpy.types.Collection) -> int:
    """Look at a loaded scene in all 3D views of the windows that show the active Blender scene.

    Views through a camera and locked ones keep their view. The clip range of a view is widened if needed. The camera's
    picture fits into the view.

    Returns:
        Number of views that changed.
    """
    found = np.array(collection.get(loaded_scenes.VIEW, ()), np.float64)
    if found.shape not in ((17,), (19,)) or not np.isfinite(found).all() or collection.r5dgs.root is None:
        return 0
    root = np.array(collection.r5dgs.root.matrix_world, np.float64)
    pose, target = found[:16].reshape(4, 4), np.eye(4)[3]
    target[:3] = pose[:3, 3] - found[16] * pose[:3, 2]
    eye, target, up = (root @ pose[:, 3])[:3], (root @ target)[:3], root[:3, :3] @ pose[:3, 1]
    axes, length = _looking(eye, target, up), float(np.linalg.norm(target - eye))
    if axes is None:
        return 0
    rotation = Matrix(axes.tolist()).to_quaternion()
    changed = 0
    for window in context.window_manager.windows:
        areas = window.screen.areas if window.scene == context.scene else ()
        for area in (area for area in areas if area.type == "VIEW_3D"):
            space = area.spaces.active
            view = space.region_3d
            if view.view_perspective == "CAMERA" or view.lock_rotation or space.region_quadviews:
                continue
            view.view_rotation, view.view_location, view.view_distance = rotation, target, length
            start, end = clip_range(length)
            space.clip_start, space.clip_end = min(space.clip_start, start), max(space.clip_end, end)
            region = next(region for region in area.regions if region.type == "WINDOW")
            space.lens = _lens(region, found[17:]) or space.lens
            changed += 1
    return changed


def _lens(region: bpy.types.Region, size: np.ndarray) -> float | None:
    """Focal length of a 3D view that shows a picture as large as possible, or None if it is not known.

    Args:
        region: Region of the view.
        size: Width and height of the picture at distance 1, empty for scenes of older versions. [2] or [0]
    """
    shown = np.array([region.width, region.height], np.float64)
    if not len(size) or shown.min() < 2 or size.min() <= 0:
        return None
    return float(np.clip(VIEW_SENSOR_MM * (shown / size).min() / shown.max(), *LENSES_MM))


def _looking(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray | None:
    """Rotation of an OpenGL camera that looks at a target, or None if no rotation does. [3, 3]

    The result is a rotation even if the root is mirrored or stretched.
    """
    back = eye - target
    right = np.cross(up, back)
    axes = np.stack([right, np.cross(back, right), back], axis=-1)
    lengths = np.linalg.norm(axes, axis=0)
    return axes / lengths if np.isfinite(lengths).all() and lengths.min() > 0 else None


def _points(scene: Scene) -> np.ndarray:
    """Sample of the Gaussians of objects, or of all if there are no objects. [n, 3]"""
    rows = np.flatnonzero(scene.gaussians.object_ids > 0)
    rows = rows if len(rows) else np.arange(len(scene.gaussians.means))
    chosen = rows[np.linspace(0, len(rows) - 1, min(SAMPLE, len(rows))).astype(int)]
    return scene.gaussians.means[chosen].astype(np.float64)


def _score(camera: cameras.Camera, points: np.ndarray) -> float:
    """Share of the points inside a camera's image, minus their mean distance from its centre in half diagonals."""
    own = points @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3]
    depth = np.maximum(own[:, 2:], 1e-9)
    pixels = (own @ camera.intrinsics.T)[:, :2] / depth
    size = np.array([camera.width, camera.height])
    inside = ((pixels >= 0) & (pixels < size)).all(1) & (own[:, 2] > 0)
    off = np.linalg.norm(pixels - size / 2, axis=1) / (np.linalg.norm(size) / 2)
    return float(inside.mean() - np.minimum(off, 1.0).mean())
