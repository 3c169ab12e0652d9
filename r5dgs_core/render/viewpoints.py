"""Viewpoints of a scene: a camera chosen by name, number or visible objects, and a time.

Visibility is measured in small pictures as a share of the picture, so it does not depend on the image size.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np

from .. import errors
from ..playback import scene_player
from ..scene import cameras as axes
from ..scene.cameras import Camera
from ..scene.sampling import spread
from ..scene.scene import Scene
from . import scene_renderer

THUMBNAIL_SIDE = 160  # longest side of the small pictures, pixels
MAX_CAMERAS = 16  # maximum number of cameras to try
NOTICED = 5e-4  # minimum share of the picture that counts as visible


@dataclasses.dataclass(frozen=True)
class Viewpoint:
    """A camera at a time.

    Attributes:
        camera: The camera, in the scene's world.
        t: Scene time.
    """

    camera: Camera
    t: float


def named(scene: Scene, which: str) -> Camera:
    """Return the camera of a scene with a name, or else with a number that counts from 0.

    Raises:
        ConfigError: The scene has no such camera.
    """
    for camera in scene.cameras:
        if camera.name == which:
            return camera
    if which.isdecimal() and int(which) < len(scene.cameras):
        return scene.cameras[int(which)]
    if not scene.cameras:
        raise errors.ConfigError(f"--camera {which}: {scene.name} stores no cameras; leave it out for an overview")
    shown = ", ".join(camera.name for camera in scene.cameras[:8])
    more = ", ..." if len(scene.cameras) > 8 else ""
    last = len(scene.cameras) - 1
    raise errors.ConfigError(f"--camera {which}: expected 0 to {last}, or a name of a camera: {shown}{more}")


def candidates(scene: Scene, camera: str | None = None, t: float | None = None) -> list[Viewpoint]:
    """List viewpoints to choose from.

    Args:
        scene: The scene.
        camera: Name or number of the camera; None for cameras spread over all.
        t: Scene time; None for the first, middle and last observed time.

    Raises:
        ConfigError: The scene has no such camera, or the time is not finite.
    """
    if t is not None and not np.isfinite(t):
        raise errors.ConfigError(f"--time {t}: expected a number, in the scene's time (t_max is {scene.t_max:g})")
    if camera is not None:
        some = [named(scene, camera)]
    elif scene.cameras:
        some = spread(scene.cameras, MAX_CAMERAS)
    else:
        some = [overview(scene)]
    first = float(scene.tracks.times[0])
    times = np.unique([scene.t_max, 0.5 * (first + scene.t_max), first])[::-1].tolist() if t is None else [float(t)]
    return [Viewpoint(view, when) for when in times for view in some]


def best(
    scene: Scene,
    among: Sequence[Viewpoint],
    object_ids: Collection[int],
    mode: str = "rigid",
    *,
    backend: str = "auto",
) -> Viewpoint:
    """Return the viewpoint that shows most of some objects: as many as possible first, then large and uncut ones.

    Args:
        scene: The scene.
        among: At least one viewpoint; the first wins a tie.
        object_ids: The objects.
        mode: Playback mode past t_max.
        backend: Rasterizer.
    """
    if len(among) == 1:
        return among[0]
    player = scene_player.Player(scene, mode)
    scores = [_score(player, viewpoint, object_ids, backend) for viewpoint in among]
    return among[max(range(len(among)), key=lambda k: scores[k])]


def overview(scene: Scene) -> Camera:
    """Return a camera that sees the whole scene obliquely from above, for scenes without cameras."""
    up = axes.WORLD_TO_BLENDER[scene.world_convention].T @ np.array([0.0, 0.0, 1.0])
    seen = scene.gaussians.means[scene.gaussians.object_ids > 0]
    points = (seen if len(seen) else scene.gaussians.means).astype(np.float64)
    middle = np.median(points, axis=0) if len(points) else np.zeros(3)
    radius = float(np.quantile(np.linalg.norm(points - middle, axis=1), 0.98)) if len(points) else 1.0
    side = np.cross(up, [1.0, 0.2, 0.1])
    back = side / np.linalg.norm(side) + 0.6 * up
    back /= np.linalg.norm(back)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, -np.cross(back, right), -back])  # OpenCV: x right, y down, z forward
    center = middle + 3.0 * max(radius, 1e-6 * scene.extent) * back
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3], T_cam_world[:3, 3] = rotation, -rotation @ center
    focal = 640 * 1.2
    return Camera(640, 480, np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1.0]]), T_cam_world, "overview")


def _score(
    player: scene_player.Player, viewpoint: Viewpoint, object_ids: Collection[int], backend: str
) -> tuple[int, float]:
    """Number of visible objects, and sum of the square roots of their shares, halved for those at the border."""
    ids = scene_renderer.render(
        player, axes.resized(viewpoint.camera, THUMBNAIL_SIDE), viewpoint.t, backend=backend
    ).ids
    border = np.concatenate([ids[0], ids[-1], ids[:, 0], ids[:, -1]])
    count, quality = 0, 0.0
    for object_id in object_ids:
        share = float((ids == object_id).mean())
        if share >= NOTICED:
            count += 1
            quality += np.sqrt(share) * (0.5 if (border == object_id).any() else 1.0)
    return count, quality
