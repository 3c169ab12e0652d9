"""Images of the static background, one per camera: the median over time of the pixels that no object covers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ...data import masks, temporal_median
from ...scene import cameras
from ...scene.sampling import spread
from ..train_views import IMAGE, MASK, TrainView, by_camera, in_turn

MAX_CAMERAS = 24
MAX_FRAMES = 31  # frames per camera for the median


@dataclass(frozen=True)
class BackgroundImage:
    """View of one camera without the objects: image [H, W, 3] in [0, 1] and mask of known pixels [H, W]."""

    camera: cameras.Camera
    image: np.ndarray
    known: np.ndarray


def compute(views: Sequence[TrainView]) -> list[BackgroundImage]:
    """Return the median over time of the unmasked pixels, one per distinct camera."""
    result = []
    for group in by_camera(views, MAX_CAMERAS):
        frames = spread(group, MAX_FRAMES)
        free = _free(frames)
        image = temporal_median.median([v.image for v in in_turn(frames, IMAGE)], free)
        result.append(BackgroundImage(group[0].camera, image, np.asarray(free.any(0))))
    return result


def _free(frames: Sequence[TrainView]) -> np.ndarray:
    """Mask of the background pixels in each frame of a camera. [F, H, W] bool

    Pixels that are unknown in all masks of the camera count as background, unless they are unexplained.
    """
    free = np.ones((len(frames), frames[0].camera.height, frames[0].camera.width), bool)
    told = np.zeros(free.shape[1:], bool)
    for k, view in enumerate(in_turn(frames, MASK)):
        mask = view.mask
        if mask is not None:
            free[k] = np.logical_not(ndimage.binary_dilation(mask > 0))
            told |= mask != masks.UNKNOWN
        else:
            told[:] = True
    free |= ~told
    for k, view in enumerate(frames):
        if view.alpha is not None:
            free[k] &= view.alpha > 127
        left_out = view.unexplained
        if left_out is not None:
            free[k] &= ~left_out
    return free
