"""Regions of the true images that training has left out, because they move although no mask names them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ..data import dataset as datasets
from ..data import unexplained
from ..data.unexplained import UsualColors
from ..scene.scene import Scene


def usual_colors(scene: Scene, dataset: datasets.Dataset, background: np.ndarray) -> dict[str, UsualColors]:
    """Return the usual colours of the fixed training cameras by name; empty if training has left out nothing.

    They are computed from the same images and masks as in training, so the regions are the same.

    Args:
        scene: The scene.
        dataset: Its data set.
        background: Colour behind transparent pixels. [3]
    """
    if not any(row.get("name") == unexplained.NEED and row.get("decision") == "on" for row in scene.needs):
        return {}

    def read(views: Sequence[datasets.View]) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
        for view in views:
            yield datasets.load_image_8bit(view, background), datasets.load_mask(view)

    return unexplained.of_cameras([view for view in dataset.train if view.mask_path is not None], read)


def explained(
    usual: Mapping[str, UsualColors], view: datasets.View, background: np.ndarray | None
) -> np.ndarray | None:
    """Return the pixels of a view outside the regions; None if its camera or mask is unknown. [H, W] bool

    Args:
        usual: Usual colours by camera.
        view: The view.
        background: Colour behind transparent pixels. [3]
    """
    if view.mask_path is None or view.camera.name not in usual:
        return None
    blocks = usual[view.camera.name].blocks(datasets.load_image_8bit(view, background), datasets.load_mask(view))
    return ~unexplained.enlarged(blocks, view.camera.height, view.camera.width)
