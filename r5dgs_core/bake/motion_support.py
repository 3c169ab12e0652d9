"""Support: significance of a simplification of a group's motion, from its comparison with the training images.

Notation as in `image_evidence`: clusters c of views, patches of a body's surface, scores g and information q.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..data import dataset as datasets

CLUSTERS = 8  # smallest number of clusters; with fewer cameras, their views are split in time


@dataclass(frozen=True)
class Support:
    """Statistics of the change of the images by a simplification of a group's motion.

    Attributes:
        sigmas: Distance (1 - l) of the simpler motion from the best fit to the images, in standard deviations; negative
            if the best fit lies beyond the simpler motion.
        clusters: Number of clusters or of patches, whichever is smaller, that the standard deviation is estimated from.
        level: Root mean square change of the pixels that show the group, colours in [0, 1].
        shape: Share of shape and texture in the change of the images; the rest is due to colours that turn with the
            group.
    """

    sigmas: float
    clusters: int
    level: float
    shape: float


@dataclass(frozen=True)
class Compared:
    """Sums of a change over the pixels of a view.

    Attributes:
        scores: Score of each patch. [P]
        information: Information of each patch. [P]
        pixels: Number of pixels that show the group.
        changed: Squared change of the colours, with the shading of each motion.
    """

    scores: np.ndarray
    information: np.ndarray
    pixels: int
    changed: float


def estimate(scores: np.ndarray, information: np.ndarray, pixels: int, changed: float) -> Support:
    """Return the support from the scores and the information of each cluster and patch. [C, P] each

    The variance is the sum of the variances over clusters and over patches, minus that over their intersections, which
    both contain.
    """
    total = float(information.sum())
    if total <= 0:
        return Support(0.0, 1, 0.0, 1.0)
    best = float(scores.sum()) / total
    left = scores - best * information
    counts = [int((information.sum(axis) > 0).sum()) for axis in (0, 1)]
    ways = [float((left.sum(axis) ** 2).sum()) * n / max(n - 1, 1) for axis, n in enumerate(counts)]
    variance = max(sum(ways) - float((left**2).sum()), *ways, 1e-12 * total)
    return Support(
        (1 - best) * total / math.sqrt(variance),
        min(counts),
        math.sqrt(total / (3 * max(pixels, 1))),
        min(1.0, total / changed) if changed > 0 else 1.0,
    )


def by_camera(views: Sequence[datasets.View]) -> dict[str, list[datasets.View]]:
    """Return the views of each camera in the order of time."""
    cameras: dict[str, list[datasets.View]] = {}
    for view in sorted(views, key=lambda view: view.t):
        cameras.setdefault(view.camera.name, []).append(view)
    return cameras


def clusters(views: Sequence[datasets.View]) -> np.ndarray:
    """Return the cluster of each view: its camera, or an interval of its camera's times if cameras are few. [V]"""
    cameras = by_camera(views)
    parts = -(-CLUSTERS // len(cameras))
    found: dict[int, int] = {}
    count = 0
    for group in cameras.values():
        for part in np.array_split(np.arange(len(group)), min(parts, len(group))):
            found |= {id(group[i]): count for i in part}
            count += 1
    if count > 2 * CLUSTERS and all(len(group) == 1 for group in cameras.values()):  # one moving camera
        order = np.argsort([view.t for view in views], kind="stable")
        result = np.zeros(len(views), int)
        for cluster, part in enumerate(np.array_split(order, CLUSTERS)):
            result[part] = cluster
        return result
    return np.array([found[id(view)] for view in views])
