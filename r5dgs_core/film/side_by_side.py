"""Captured images beside the pictures of their camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import OpenImageIO as oiio

from .. import errors
from ..data import dataset as datasets
from ..data.splits import SPLITS
from ..scene import sampling
from . import camera_path
from .schedule import Shot

EMPTY = 0.16  # gray of times without an image


class CapturedImages:
    """Images of one camera of a data set.

    Args:
        dataset: The data set.
        camera: Name of the camera.
        background: Colour behind transparent pixels, sRGB. [3]

    Raises:
        ConfigError: The data set has no images of the camera.
    """

    def __init__(self, dataset: datasets.Dataset, camera: str, background: np.ndarray):
        views = [view for split in SPLITS for view in dataset.views(split)]
        self._views = sorted((view for view in views if view.camera.name == camera), key=lambda view: view.t)
        if not self._views:
            known = ", ".join(camera.name for camera in dataset.cameras[:8])
            raise errors.ConfigError(f"--beside {dataset.root}: no images of camera {camera!r}; it has {known}")
        times = np.unique([view.t for view in views])
        self._times, self._reach = np.array([view.t for view in self._views]), 0.5 * sampling.spacing(times)
        self._background = background

    def at(self, shot: Shot) -> np.ndarray:
        """Return the image nearest in time to a frame, gray if the camera has none near that time. [H, W, 3] float32"""
        camera = shot.camera
        canvas = np.full((camera.height, camera.width, 3), EMPTY, np.float32)
        nearest = int(np.argmin(np.abs(self._times - shot.t)))
        if abs(self._times[nearest] - shot.t) > self._reach * (1 + 1e-6):
            return canvas
        image = np.clip(datasets.load_image(self._views[nearest], self._background), 0, 1)
        return _placed(image, canvas)


def joined(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Return pictures side by side, the first on the left. [H, W, 3 or 4] each"""
    return np.concatenate([picture[..., :3] for picture in pictures], 1)


def _placed(image: np.ndarray, canvas: np.ndarray) -> np.ndarray:
    """Return an image scaled into the middle of a canvas, as `camera_path.fitted` places the camera's picture."""
    height, width = canvas.shape[:2]
    size, left, top = camera_path.placement((image.shape[1], image.shape[0]), (width, height))
    source = oiio.ImageBuf(np.ascontiguousarray(image, np.float32))
    scaled = oiio.ImageBufAlgo.resize(source, roi=oiio.ROI(0, size[0], 0, size[1], 0, 1, 0, 3))
    pixels = np.asarray(scaled.get_pixels(oiio.FLOAT))
    canvas[top : top + size[1], left : left + size[0]] = pixels[: height - top, : width - left]
    return canvas
