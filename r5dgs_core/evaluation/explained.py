"""Explained pixels of the true images, if training has left out regions that move although no mask names them."""

from __future__ import annotations

import numpy as np

from ..data import dataset as datasets
from ..data import unexplained
from ..data.explained_pixels import ExplainedPixels
from ..scene.scene import Scene


def pixels(scene: Scene, dataset: datasets.Dataset, background: np.ndarray) -> ExplainedPixels | None:
    """Return the explained pixels of the fixed training cameras; None if training has left out nothing.

    Args:
        scene: The scene.
        dataset: Its data set.
        background: Colour behind transparent pixels. [3]
    """
    left_out = any(row.get("name") == unexplained.NEED and row.get("decision") == "on" for row in scene.needs)
    return ExplainedPixels(dataset, background) if left_out else None
