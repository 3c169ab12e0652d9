"""Initial backgrounds without matching of images: random points, and points of a reconstruction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...data import masks
from ...scene import cameras
from ..normalization import TARGET_DISTANCE
from ..train_views import MASK, TrainView, in_turn
from .background_images import BackgroundImage
from .visual_hull import pixel_indices

REACH = 1.5  # half the side of the sampled cube / distance of the cameras from their focus
BATCHES = 64


def random_points(
    backgrounds: Sequence[BackgroundImage], count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw random points that at least two cameras see (one if there is only one camera).

    Args:
        backgrounds: Background image of each camera; normalised coordinates.
        count: Number of points; fewer are returned if the cameras see little of the space around their focus.
        rng: Random generator.

    Returns:
        Points [P, 3] and colours near middle grey [P, 3].
    """
    needed = min(2, len(backgrounds))
    kept, found = [np.zeros((0, 3))], 0
    for _ in range(BATCHES):
        points = rng.uniform(-REACH * TARGET_DISTANCE, REACH * TARGET_DISTANCE, (count, 3))
        seen = np.zeros(len(points), np.int64)
        for background in backgrounds:
            pixels, depth = cameras.project(background.camera, points)
            with np.errstate(invalid="ignore"):
                inside = (pixels >= 0).all(1) & (pixels < [background.camera.width, background.camera.height]).all(1)
            seen += inside & (depth > 0)
        kept.append(points[seen >= needed])
        found += len(kept[-1])
        if found >= count:
            break
    where = np.concatenate(kept)[:count]
    return where, np.clip(0.5 + 0.1 * rng.standard_normal(where.shape), 0, 1)


def behind_objects(
    points: np.ndarray, colors: np.ndarray, views: Sequence[TrainView], count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Select the points of a reconstruction that belong to the background.

    Args:
        points: Points, normalised coordinates. [P, 3]
        colors: Their colours. [P, 3]
        views: Training views.
        count: Maximum number of points.
        rng: Random generator.

    Returns:
        Points covered by objects in at most a third of the views that have them in the frame, and their colours. [Q, 3]
        each
    """
    shown, covered = np.zeros(len(points)), np.zeros(len(points))
    for view in in_turn([view for view in views if view.has_mask], MASK):
        columns, rows, valid = pixel_indices(view, points)
        mask = view.mask
        assert mask is not None
        ids = mask[rows, columns]
        valid &= ids != masks.UNKNOWN
        shown += valid
        covered += valid & (ids > 0)
    free = np.flatnonzero(covered <= shown / 3)
    kept = np.sort(rng.permutation(free)[:count])
    return points[kept], colors[kept]
