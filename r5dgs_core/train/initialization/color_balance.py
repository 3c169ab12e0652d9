"""Colours of the cameras relative to each other, from points of the background that several of them see.

A camera k shows a colour c as gain_k c + offset_k in each channel. The plane sweep finds points although the colours
are somewhat wrong; the colours that the cameras show of these points determine gains and offsets up to a common map, as
which the means of both are kept. Better colours give better points, so this is repeated.

Notation: C cameras (background images), P points.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ...scene import cameras
from ..train_views import TrainView
from . import plane_sweep
from .background_images import BackgroundImage

log = logging.getLogger(__name__)

THRESHOLD_DB = 2.0  # minimum decrease of the differences at points to which the colours were not fitted
ROUNDS = 3  # number of sweeps with corrected colours
POINTS, FEWEST = 2000, 60  # points that are compared; minimum number of points of each camera
ALTERNATIONS = 15
DARK, BRIGHT = 0.02, 0.97  # colours outside of this range are cut off
ROBUST = 0.02  # difference beyond which a colour loses weight
GAIN_PRIOR, OFFSET_PRIOR = 3e-4, 4e-3  # weight of a gain of 1 and an offset of 0, relative to the points


@dataclass(frozen=True)
class ColorBalance:
    """Colours of the cameras.

    Attributes:
        names: Name of each camera.
        gains: Gain of each channel; the mean over the cameras is 1. [C, 3]
        offsets: Offset of each channel; the mean is 0. [C, 3]
        gain_db: Decrease of the differences between cameras at points that were not fitted, dB.
    """

    names: tuple[str, ...]
    gains: np.ndarray
    offsets: np.ndarray
    gain_db: float

    def corrected(self, image: np.ndarray, name: str) -> np.ndarray:
        """Return the scene's colours in an image of a camera. [H, W, 3] in [0, 1]"""
        row = self.names.index(name)
        return np.clip((image - self.offsets[row]) / self.gains[row], 0, 1).astype(np.float32)

    def views(self, views: Sequence[TrainView]) -> list[TrainView]:
        """Return views with corrected images, which are corrected when they are used."""

        def in_bytes(name: str, image: np.ndarray) -> np.ndarray:
            return np.round(255 * self.corrected(image / np.float32(255), name)).astype("u1")

        return [view.with_image_function("balanced", functools.partial(in_bytes, view.camera.name)) for view in views]

    def backgrounds(self, images: Sequence[BackgroundImage]) -> list[BackgroundImage]:
        """Return background images with corrected colours."""
        return [dataclasses.replace(b, image=self.corrected(b.image, b.camera.name)) for b in images]


def find(images: Sequence[BackgroundImage], sweep: plane_sweep.Sweep, depths: int, forced: bool) -> ColorBalance | None:
    """Find the colours of the cameras.

    Args:
        images: Background image of each camera, with the camera's name.
        sweep: Plane sweep of these images.
        depths: Depths per ray of further sweeps.
        forced: True to return colours even if they do not help.

    Returns:
        The colours; None if the cameras do not differ, or too few points are seen by several of them.
    """
    found: ColorBalance | None = None
    for _ in range(ROUNDS):
        seen = _shown(images, sweep)
        if seen is None:
            break
        found = _solved(tuple(b.camera.name for b in images), seen)
        log.info("colours of the cameras differ: %.1f dB of %d points", found.gain_db, len(seen))
        if found.gain_db < THRESHOLD_DB and not forced:
            return None
        sweep = plane_sweep.Sweep(found.backgrounds(images), POINTS, depths)
    return found


def _shown(images: Sequence[BackgroundImage], sweep: plane_sweep.Sweep) -> np.ndarray | None:
    """Return the colours that the cameras show of points, NaN if a camera does not show a point. [P, C, 3]"""
    points, owners, seen = sweep.matches()
    if len(points) == 0:
        return None
    chosen = np.arange(len(points))[:: math.ceil(len(points) / POINTS)]
    points, owners, seen = points[chosen], owners[chosen], seen[:, chosen]
    colors = np.full((len(points), len(images), 3), np.nan)
    for row, image in enumerate(images):
        mine = seen[row] | (owners == row)
        pixels, _ = cameras.project(image.camera, points[mine])
        smooth = ndimage.gaussian_filter(image.image, (0.7, 0.7, 0))
        at = [pixels[:, 1] - 0.5, pixels[:, 0] - 0.5]
        shown = np.stack([ndimage.map_coordinates(smooth[..., c], at, order=1, mode="nearest") for c in range(3)], -1)
        known = ndimage.map_coordinates(image.known.astype(np.float32), at, order=0, mode="nearest") > 0.5
        good = known[:, None] & (shown > DARK) & (shown < BRIGHT)
        colors[mine, row] = np.where(good, shown, np.nan)
    several = (np.isfinite(colors).all(2)).sum(1) >= 2
    colors = colors[several]
    enough = np.isfinite(colors).all(2).sum(0).min(initial=len(colors)) >= FEWEST
    return colors if enough else None


def _solved(names: tuple[str, ...], colors: np.ndarray) -> ColorBalance:
    """Fit gains and offsets to every second point, and measure the decrease of the differences at the others."""
    gains, offsets = _fitted(colors[::2])
    before, after = (_difference(colors[1::2], g, o) for g, o in ((1 + 0 * gains, 0 * offsets), (gains, offsets)))
    return ColorBalance(names, gains, offsets, 20 * math.log10(before / max(after, 1e-9)))


def _fitted(colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return gains and offsets by alternating least squares with robust weights. [P, C, 3] -> [C, 3] each"""
    gains, offsets = np.ones(colors.shape[1:]), np.zeros(colors.shape[1:])
    shown = np.nan_to_num(colors)
    for _ in range(ALTERNATIONS):
        scene, weights = _consensus(colors, gains, offsets)
        c, total = scene[:, None], weights.sum(0)
        a, b = ((weights * c**2).sum(0) + GAIN_PRIOR * total, (1 + OFFSET_PRIOR) * total)
        mixed, by_c = (weights * c).sum(0), (weights * c * shown).sum(0) + GAIN_PRIOR * total
        plain = (weights * shown).sum(0)
        determinant = np.maximum(a * b - mixed**2, 1e-12)
        gains = (by_c * b - plain * mixed) / determinant
        offsets = (plain * a - by_c * mixed) / determinant
        gains /= gains.mean(0)
        offsets -= offsets.mean(0)
    return gains, offsets


def _consensus(colors: np.ndarray, gains: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the colour of each point [P, 3], the mean over its cameras, and the weights of its colours [P, C, 3]."""
    each = (colors - offsets) / gains
    middle = np.nanmedian(each, axis=1)
    weights = np.nan_to_num(1 / (1 + (np.abs(each - middle[:, None]) / ROBUST) ** 2))
    scene = (weights * np.nan_to_num(each)).sum(1) / np.maximum(weights.sum(1), 1e-9)
    return scene, weights


def _difference(colors: np.ndarray, gains: np.ndarray, offsets: np.ndarray) -> float:
    """Return the median difference of the colours of a point from their median."""
    each = (colors - offsets) / gains
    return float(np.nanmedian(np.abs(each - np.nanmedian(each, axis=1)[:, None]).mean(2)))
