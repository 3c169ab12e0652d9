"""Frames of one camera as images of the data set: undistorted and reduced."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from .. import extras
from ..capture.calibration import undistort
from ..capture.calibration.lens import Lens
from ..data import masks
from . import image_size


@dataclass(frozen=True)
class Rectifier:
    """Undistorts and reduces the frames of a lens.

    Attributes:
        undistortion: The pinhole camera and its map, at the size of the frames.
        width: Width of the images, pixels.
        height: Height of the images, pixels.
    """

    undistortion: undistort.Undistortion
    width: int
    height: int

    @property
    def intrinsics(self) -> np.ndarray:
        """Camera matrix of the images, pixels. [3, 3]"""
        scale = np.array([self.width / self.undistortion.width, self.height / self.undistortion.height, 1.0])
        return self.undistortion.intrinsics * scale[:, None]

    def image(self, pixels: np.ndarray) -> np.ndarray:
        """Return a frame as an image. [H, W, 3] uint8 -> [h, w, 3] uint8"""
        result = self.undistortion.apply(pixels)
        if result.shape[:2] == (self.height, self.width):
            return result
        with extras.required("resizing of frames", "prepare"):
            import cv2
        return cv2.resize(result, (self.width, self.height), interpolation=cv2.INTER_AREA)

    def mask(self, ids: np.ndarray, place: str) -> np.ndarray:
        """Return a mask of a frame as a mask of its image, unknown beyond the frame. [H, W] -> [h, w] int32"""
        size = self.undistortion.width, self.undistortion.height
        full = masks.resize(ids, *size, place).astype(np.uint16)
        full = np.where(self.undistortion.known, self.undistortion.apply(full, nearest=True), masks.UNKNOWN)
        return masks.resize(full.astype(np.int32), self.width, self.height, place)


@functools.lru_cache(maxsize=1)  # frames of a camera follow each other, and a map takes eight bytes per pixel
def rectifier(lens: Lens, size: tuple[int, int], lines: int) -> Rectifier:
    """Return the rectifier of a lens.

    Args:
        lens: The lens, for the size of the frames.
        size: Width and height of the frames.
        lines: Largest height of the images.
    """
    return Rectifier(undistort.undistortion(lens, size), *image_size.scaled(size, lines))
