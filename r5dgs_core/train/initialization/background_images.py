"""Images of the static background, one per camera: the median over time of the pixels that no object covers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ...data import masks
from ...scene import cameras
from ...scene.sampling import spread
from ..train_views import IMAGE, MASK, TrainView, by_camera, in_turn

MAX_CAMERAS = 24
MAX_FRAMES = 31  # frames per camera for the median
MEDIAN_VALUES = 1 << 23  # colours per sorted band


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
        image = _median([v.image for v in in_turn(frames, IMAGE)], free)
        result.append(BackgroundImage(group[0].camera, image, np.asarray(free.any(0))))
    return result


def _median(images: Sequence[np.ndarray], free: np.ndarray) -> np.ndarray:
    """Return the median of the free pixels, 0 if a pixel is never free; computed in bands to save memory.

    Args:
        images: F images. [H, W, 3] uint8
        free: Mask of the pixels that count. [F, H, W] bool

    Returns:
        Colours in [0, 1]. [H, W, 3] float32
    """
    count, height, width = free.shape
    result = np.zeros((height, width, 3), np.float32)
    rows = max(1, MEDIAN_VALUES // (3 * count * width))
    for top in range(0, height, rows):
        band = slice(top, top + rows)
        values = np.stack([image[band] for image in images]).astype(np.int16)
        values[~free[:, band]] = 256  # sorts after all colours
        values.sort(axis=0)
        free_count = free[:, band].sum(0)
        low, high = (
            np.take_along_axis(values, np.broadcast_to(k[None, ..., None], (1, *values.shape[1:])), 0)[0]
            for k in (np.maximum(free_count - 1, 0) // 2, np.minimum(free_count // 2, count - 1))
        )
        middle = (low + high).astype(np.float32) / np.float32(510)
        result[band] = np.where((free_count > 0)[..., None], middle, np.float32(0))
    return result


def _free(frames: Sequence[TrainView]) -> np.ndarray:
    """Mask of the background pixels in each frame of a camera. [F, H, W] bool

    Pixels that are unknown in all masks of the camera count as background.
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
    return free
