"""Initial points of objects: random points inside the visual hull of the masks at one time.

Notation: V views at the reference time, P candidate points.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...data import masks
from ...scene import cameras
from ..train_views import TrainView

log = logging.getLogger(__name__)

LIMITS = (0.0, 0.1, 0.2, 0.35, 0.5)  # shares of votes against a point that are tried in turn
CELLS = 60  # cells of a mask, which the object's points should fill
FILLED = 0.8  # smallest share of a mask's cells that points of the whole object fill
MIN_CELLS = 20  # smaller masks are not compared
HELPS = 0.1  # gain of this share by which a view is left out
MIN_VIEWS = 2  # minimum number of views that vote against points


@dataclass(frozen=True)
class Outline:
    """Mask of an object in a view, in cells.

    Attributes:
        cells: Cell of each point. [P]
        filled: Cells of the mask.
    """

    cells: np.ndarray
    filled: np.ndarray

    def share(self, points: np.ndarray) -> float:
        """Return the share of the mask's cells that some points fill. [P] bool"""
        return float(np.isin(self.filled, self.cells[points]).mean())


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
    inside, outside, seen = (np.zeros((len(views), len(points)), bool) for _ in range(3))
    colors = np.zeros((len(points), 3))
    usual, pixels = np.zeros(3), 0
    outlines: list[Outline | None] = []
    for number, view in enumerate(views):
        mask = view.mask
        if mask is None or not (marked := mask == object_id).any():
            outlines.append(None)
            continue
        image = view.image
        usual += image[marked].sum(0) / 255
        pixels += int(marked.sum())
        columns, rows, valid = pixel_indices(view, points)
        ids = np.where(valid, mask[rows, columns].astype(np.int64), -1)
        inside[number] = ids == object_id
        outside[number] = ids == 0
        seen[number] = valid & (ids != masks.UNKNOWN)
        colors += inside[number][:, None] * (image[rows, columns] / 255.0)
        outlines.append(_outline(marked, rows, columns))
    good, hiding = _chosen(inside, outside, seen, outlines, min(50, count))
    if hiding:
        log.info("object %d: something hides a part of it in %d of %d views", object_id, len(hiding), len(views))
    votes = inside.sum(0)
    chosen = np.flatnonzero(good)
    if len(chosen) == 0:
        chosen = np.argsort(np.linalg.norm(points - center, axis=1))[:count]
    chosen = rng.choice(chosen, count, replace=len(chosen) < count)
    mean = usual / pixels if pixels else np.full(3, 0.5)
    known = votes[chosen, None] > 0
    return points[chosen], np.where(known, colors[chosen] / np.maximum(votes[chosen, None], 1), mean)


def _outline(marked: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> Outline:
    """Divide a mask into about `CELLS` square cells, and find the cell of each point's pixel."""
    size = max(1, round(float(np.sqrt(marked.sum() / CELLS))))
    wide = marked.shape[1] // size + 1
    cells = rows // size * wide + columns // size
    row, column = np.nonzero(marked)
    found, area = np.unique(row // size * wide + column // size, return_counts=True)
    return Outline(cells, found[area >= 0.5 * size * size])


def _chosen(
    inside: np.ndarray, outside: np.ndarray, seen: np.ndarray, outlines: Sequence[Outline | None], enough: int
) -> tuple[np.ndarray, list[int]]:
    """Select the points of the object, and the views in which something without an id hides a part of it.

    Points that fill an object fill each of its masks. If they do not, some view votes against points that it cannot
    see. Views are left out, best one first, while this helps.

    Args:
        inside, outside, seen: Votes of the views for and against each point, and whether they see its place. [V, P]
        outlines: Masks of the views; None if a view does not show the object. V
        enough: Number of points that suffices.

    Returns:
        The selected points [P] bool, and indices of the views whose votes against points do not count.
    """

    votes, against, total = inside.sum(0), outside.sum(0), seen.sum(0)
    compared = [x for x in outlines if x is not None and len(x.filled) >= MIN_CELLS]
    left = [number for number, x in enumerate(outlines) if x is not None]
    hiding: list[int] = []
    best = _select(votes, against, total, enough)
    while True:
        shares = [x.share(best) for x in compared]
        if min(shares, default=1.0) >= FILLED or len(left) <= MIN_VIEWS:
            return best, hiding
        # The worst masks come first, because they reject most views at once.
        compared = [compared[k] for k in np.argsort(shares, kind="stable")]
        needed, found = min(shares) + HELPS, None
        for number in left:
            good = _select(votes, against - outside[number], total - seen[number] + inside[number], enough)
            reached = 1.0
            for x in compared:
                reached = min(reached, x.share(good))
                if reached < needed:
                    break
            if reached >= needed and (found is None or reached > needed):
                needed, found, best = reached, number, good
        if found is None:
            return best, hiding
        hiding.append(found)
        left.remove(found)
        against, total = against - outside[found], total - seen[found] + inside[found]


def _select(votes: np.ndarray, against: np.ndarray, total: np.ndarray, enough: int) -> np.ndarray:
    """Return the points with few votes against them [P] bool; the limit is relaxed until they suffice.

    Args:
        votes, against, total: Number of votes for and against each point, and of views that count. [P]
        enough: Number of points that suffices.
    """
    good = np.zeros(len(votes), bool)
    for limit in LIMITS:
        good = (votes >= np.maximum(1, 0.5 * total)) & (against <= limit * total)
        if good.sum() >= enough:
            break
    return good


def pixel_indices(view: TrainView, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return columns, rows and validity of the pixels of points [P, 3]; invalid indices are set to 0."""
    pixels, _ = cameras.project(view.camera, points)
    height, width = view.camera.height, view.camera.width
    with np.errstate(invalid="ignore"):
        valid = (pixels[:, 0] >= 0) & (pixels[:, 0] < width) & (pixels[:, 1] >= 0) & (pixels[:, 1] < height)
    columns = np.where(valid, np.nan_to_num(pixels[:, 0]), 0).astype(np.int64)
    rows = np.where(valid, np.nan_to_num(pixels[:, 1]), 0).astype(np.int64)
    return columns, rows, valid
