"""Undistortion: the pinhole camera that replaces a lens, and the map from its pixels to those of the source image."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from ... import extras
from .lens import Lens

WIDEST_TANGENT = math.tan(math.radians(60))  # beyond it a pinhole image stretches objects to more than four times
_BORDER_SAMPLES = 129  # per side of the image
_ROWS = 64  # rows per block, to bound the memory
_EDGE = 0.5  # a pixel's area reaches half a pixel beyond its centre


@dataclass(frozen=True, eq=False)
class Undistortion:
    """A pinhole camera, and where its pixels lie in the source image.

    Attributes:
        lens: Lens of the source image.
        pinhole: Lens of the new image.
        width: Width of both images in pixels.
        height: Height of both images in pixels.
    """

    lens: Lens
    pinhole: Lens
    width: int
    height: int

    @property
    def intrinsics(self) -> np.ndarray:
        """Camera matrix of the new image, pixels, the first pixel's centre at 0.5. [3, 3]"""
        return self.pinhole.intrinsics

    @property
    def identity(self) -> bool:
        """True if the new image is the source image."""
        return self.pinhole == self.lens

    @functools.cached_property
    def _maps(self) -> tuple[np.ndarray, np.ndarray]:
        maps = np.empty((2, self.height, self.width), np.float32)
        for first in range(0, self.height, _ROWS):
            rows = np.arange(first, min(first + _ROWS, self.height))
            pixels = np.stack(np.meshgrid(np.arange(self.width) + 0.5, rows + 0.5), -1).reshape(-1, 2)
            source = self.lens.project(self.pinhole.unproject(pixels)) - 0.5
            maps[:, rows] = source.T.reshape(2, -1, self.width)
        maps[np.isnan(maps)] = -1e4
        return maps[0], maps[1]

    @property
    def map_x(self) -> np.ndarray:
        """Column in the source image of each new pixel, the first column at 0 as in OpenCV. [H, W] float32"""
        return self._maps[0]

    @property
    def map_y(self) -> np.ndarray:
        """Row in the source image, the first at 0. [H, W] float32"""
        return self._maps[1]

    @functools.cached_property
    def known(self) -> np.ndarray:
        """Pixels that lie in the source image; the others show nothing. [H, W] bool"""
        x, y = self._maps
        in_columns = (x >= -_EDGE) & (x <= self.width - 1 + _EDGE)
        return in_columns & (y >= -_EDGE) & (y <= self.height - 1 + _EDGE)

    def apply(self, pixels: np.ndarray, *, nearest: bool = False) -> np.ndarray:
        """Undistort an image or a mask; unknown pixels repeat the border.

        Args:
            pixels: Source image. [H, W] or [H, W, C]; uint8, uint16 or float32
            nearest: Take the nearest pixel, for masks, instead of cubic interpolation.

        Raises:
            BackendError: OpenCV is not installed.
        """
        if self.identity:
            return pixels
        with extras.required("undistortion", "prepare"):
            import cv2
        way = cv2.INTER_NEAREST if nearest else cv2.INTER_CUBIC
        result = cv2.remap(pixels, self.map_x, self.map_y, way, borderMode=cv2.BORDER_REPLICATE)
        return result.reshape(self.height, self.width, *pixels.shape[2:])


def undistortion(lens: Lens, size: tuple[int, int], *, field: float = 0.0) -> Undistortion:
    """Choose a pinhole camera with square pixels for a lens. The map of its pixels is computed on first use.

    A lens without distortion is kept as it is.

    Args:
        lens: Lens of the source image.
        size: Width and height of the source image, and of the new one.
        field: Field of view. 0 takes the largest view that the source fills, 1 the smallest that holds all of the
            source; between them the view is interpolated. Views end at 60 degrees from the axis.
    """
    width, height = size
    if lens.is_pinhole:
        return Undistortion(lens, lens, width, height)
    inner, outer = _boxes(lens, width, height)
    left, top, right, bottom = (1 - field) * inner + field * outer
    scales = np.array([(width - 1) / (right - left), (height - 1) / (bottom - top)])
    focal = float(scales.max() * (1 - field) + scales.min() * field)
    center = np.array([width, height]) / 2 - focal * np.array([left + right, top + bottom]) / 2
    pinhole = Lens("pinhole", focal, focal, float(center[0]), float(center[1]))
    return Undistortion(lens, pinhole, width, height)


def _boxes(lens: Lens, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Boxes left, top, right, bottom in the tangent plane: within the image's border, and around it. [4], [4]"""
    x, y = np.linspace(0.5, width - 0.5, _BORDER_SAMPLES), np.linspace(0.5, height - 0.5, _BORDER_SAMPLES)
    inner, outer = np.empty(4), np.empty(4)
    edges = (np.stack([np.full_like(y, 0.5), y], 1), np.stack([x, np.full_like(x, 0.5)], 1))
    edges += (np.stack([np.full_like(y, width - 0.5), y], 1), np.stack([x, np.full_like(x, height - 0.5)], 1))
    for side, pixels in enumerate(edges):
        axis, sign = side % 2, 1 if side >= 2 else -1
        directions = lens.unproject(pixels)
        # A direction beyond the model or behind the camera lies outside every view.
        seen = np.isfinite(directions).all(1) & (directions[:, 2] > 1e-6)
        tangent = np.where(seen, sign * directions[:, axis] / np.where(seen, directions[:, 2], 1.0), np.inf)
        tangent = np.minimum(tangent, WIDEST_TANGENT)
        inner[side], outer[side] = sign * tangent.min(), sign * tangent.max()
    return inner, outer
