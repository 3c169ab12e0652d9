"""Weighted bags of Gaussians for the segments of a data set's masks, from rendering the scene in each view."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..data import dataset as datasets
from ..data import masks as id_masks
from ..masks import videos
from ..playback import scene_player
from ..raster import RasterSettings
from ..render import posed_scene, scene_renderer, segment_weights
from ..scene import cameras
from ..scene.cameras import Camera
from ..scene.scene import Scene
from . import segment_stack

MIN_WEIGHT = 0.02  # minimum weight of a Gaussian in a segment's bag, pixels


def draw(
    scene: Scene,
    views: Sequence[datasets.View],
    masks: Sequence[np.ndarray],
    *,
    backend: str = "auto",
    progress: Callable[[int], None] | None = None,
) -> list[segment_stack.ImageBags]:
    """Render the scene in each view and sum the blending weights over the segments of its mask.

    Args:
        scene: The scene; within the observed time it is played with its learned motion and residuals.
        views: Views in the scene's world.
        masks: Incoming ids of each view, 0 = background, `masks.UNKNOWN` = ignored. Sequence of [H, W]
        progress: Called with the number of finished views.

    Returns:
        Bags of the views, in their order. ``view`` is equal for images of one video with a common numbering.
    """
    video_of = {view.name: (video.name, view.mask_video) for video in videos.of(views) for view in video.views}
    number = {which: k for k, which in enumerate(dict.fromkeys(video_of.values()))}
    player, drawn = scene_player.Player(scene), []
    for done, (view, mask) in enumerate(zip(views, masks, strict=True)):
        gaussians, camera = relative_to_camera(player, view.camera, view.t)
        ids, segments, pixels = np.unique(mask, return_inverse=True, return_counts=True)
        known = ids != id_masks.UNKNOWN
        weights = segment_weights.segment_weights(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            gaussians.opacities,
            camera,
            segments.reshape(mask.shape),
            len(ids),
            settings=RasterSettings(near_plane=scene.near_plane),
            backend=backend,
        )[known]
        weights.data[weights.data < MIN_WEIGHT] = 0
        weights.eliminate_zeros()
        drawn.append(
            segment_stack.ImageBags(
                ids[known].astype(np.int32), pixels[known], weights, number[video_of[view.name]], view.t
            )
        )
        if progress is not None:
            progress(done + 1)
    return drawn


def relative_to_camera(
    player: scene_player.Player, camera: Camera, t: float
) -> tuple[scene_renderer.PosedGaussians, Camera]:
    """Return the Gaussians at a time relative to the position of a camera, and the camera moved to the origin.

    Near the origin float32 is most precise, as in `scene_renderer.render`.
    """
    posed = posed_scene.pose_frame(player.scene, player.frame(t, camera.center))
    return scene_renderer.PosedGaussians(posed), cameras.translated(camera, -posed.origin)


def paths(scene: Scene, times: np.ndarray) -> np.ndarray:
    """Positions of each Gaussian at some times. [S] -> [N, S, 3] float32"""
    player = scene_player.Player(scene)
    return np.stack([player.frame(float(t)).means for t in times], axis=1)
