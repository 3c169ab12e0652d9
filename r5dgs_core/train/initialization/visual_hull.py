"""Initial points of objects: random points inside the visual hull of the masks at one time.

Notation: V views at the reference time, P candidate points.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...data import masks
from ...scene import cameras
from ..train_views import TrainView


def carve(
    views: Sequence[TrainView],
    object_id: int,
    center: np.ndarray,
    radius: float,
    count: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw points that are inside an object according to its masks.

    Each view whose mask shows the object votes on the points in its frame: for a point if its pixel shows the object,
    against it if its pixel shows the background, and not at all if another object or an unknown region covers it. At
    first no vote against a point is allowed; the limit is relaxed until enough points are found, so that noisy masks
    also give a result.

    Args:
        views: Views at the reference time.
        object_id: The object.
        center: Its triangulated centre. [3]
        radius: Radius of a ball that contains it.
        count: Number of points.
        rng: Random generator.

    Returns:
        Points [count, 3] and their colours, averaged over the views that show the object there [count, 3] in [0, 1]. If
        no point can be carved, points of a small ball in the object's mean colour (grey if it is never visible).
    """
    direction = rng.normal(size=(24 * count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = center + direction * (1.3 * radius * rng.random((len(direction), 1)) ** (1 / 3))
    inside = np.zeros(len(points))
    outside = np.zeros(len(points))
    seen = np.zeros(len(points))
    colors = np.zeros((len(points), 3))
    usual, pixels = np.zeros(3), 0
    for view in views:
        if view.mask is None or not (marked := view.mask == object_id).any():
            continue
        usual += view.image[marked].sum(0) / 255
        pixels += int(marked.sum())
        columns, rows, valid = pixel_indices(view, points)
        ids = np.where(valid, view.mask[rows, columns].astype(np.int64), -1)
        here = ids == object_id
        inside += here
        outside += ids == 0
        seen += valid & (ids != masks.UNKNOWN)
        colors += here[:, None] * (view.image[rows, columns] / 255.0)
    for limit in (0.0, 0.1, 0.2, 0.35, 0.5):
        good = (inside >= np.maximum(1, 0.5 * seen)) & (outside <= limit * seen)
        if good.sum() >= min(50, count):
            break
    chosen = np.flatnonzero(good)
    if len(chosen) == 0:
        chosen = np.argsort(np.linalg.norm(points - center, axis=1))[:count]
    chosen = rng.choice(chosen, count, replace=len(chosen) < count)
    mean = usual / pixels if pixels else np.full(3, 0.5)
    known = inside[chosen, None] > 0
    return points[chosen], np.where(known, colors[chosen] / np.maximum(inside[chosen, None], 1), mean)


def pixel_indices(view: TrainView, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return columns, rows and validity of the pixels of points [P, 3]; invalid indices are set to 0."""
    pixels, _ = cameras.project(view.camera, points)
    height, width = view.image.shape[:2]
    with np.errstate(invalid="ignore"):
        valid = (pixels[:, 0] >= 0) & (pixels[:, 0] < width) & (pixels[:, 1] >= 0) & (pixels[:, 1] < height)
    columns = np.where(valid, np.nan_to_num(pixels[:, 0]), 0).astype(np.int64)
    rows = np.where(valid, np.nan_to_num(pixels[:, 1]), 0).astype(np.int64)
    return columns, rows, valid
