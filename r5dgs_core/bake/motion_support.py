"""Support: significance of a simplification of a group's motion, from its comparison with the training images.

Notation as in `image_evidence`: clusters c of views, patches of a body's surface, scores g and information q.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


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
