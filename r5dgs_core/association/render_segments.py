"""The bags of a data set's masks: each image is drawn as the scene has it, and its Gaussians sorted by segments."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from ..data import dataset as datasets
from ..data import masks as id_masks
from ..masks import videos
from ..playback import scene_player
from ..raster import RasterSettings
from ..render import scene_renderer, segment_weights
from ..scene.scene import Scene
from . import segment_stack

LEAST = 0.02  # of a pixel: what a Gaussian has to give a segment to be in its bag


def draw(
    scene: Scene,
    views: Sequence[datasets.View],
    masks: Sequence[np.ndarray],
    *,
    backend: str = "auto",
    progress: Callable[[int], None] | None = None,
) -> list[segment_stack.ImageBags]:
    """Draw the scene as each view sees it and sum weights over the segments of its mask.

    Args:
        scene: The scene; in the observed time it moves as it was learned, residuals included.
        views: Views of the scene's world.
        masks: Incoming ids of each, 0 = background, `masks.UNKNOWN` = left out. Of [H, W]
        backend: Rasterizer.
        progress: Called with the number of views that are done.

    Returns:
        Bags of the views, in their order; images of one video belong together, as far as their masks were numbered
        together.
    """
    video_of = {view.name: (video.name, view.mask_video) for video in videos.of(views) for view in video.views}
    number = {which: k for k, which in enumerate(dict.fromkeys(video_of.values()))}
    drawn = []
    for done, (view, mask) in enumerate(zip(views, masks, strict=True)):
        posed = scene_renderer.pose_frame(scene, scene_player.frame(scene, view.t))
        gaussians = scene_renderer.PosedGaussians(posed)
        ids, segments, pixels = np.unique(mask, return_inverse=True, return_counts=True)
        known = ids != id_masks.UNKNOWN
        weights = segment_weights.segment_weights(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            gaussians.opacities,
            view.camera,
            torch.from_numpy(segments.reshape(mask.shape)),
            len(ids),
            settings=RasterSettings(near_plane=scene.near_plane),
            backend=backend,
        )[known]
        weights.data[weights.data < LEAST] = 0
        weights.eliminate_zeros()
        drawn.append(
            segment_stack.ImageBags(
                ids[known].astype(np.int32), pixels[known], weights, number[video_of[view.name]], view.t
            )
        )
        if progress is not None:
            progress(done + 1)
    return drawn


def paths(scene: Scene, times: np.ndarray) -> np.ndarray:
    """Where each Gaussian is at some times. [S] -> [N, S, 3] float32"""
    return np.stack([scene_player.frame(scene, float(t)).means for t in times], axis=1)
