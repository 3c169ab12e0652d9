"""Pixels of images outside the regions that training has left out, because they move although no mask names them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from . import dataset as datasets
from . import images, unexplained
from .dataset import Dataset, View


class ExplainedPixels:
    """Explained pixels of the images of fixed training cameras.

    The usual colours are computed from the same images and masks as in training, so the regions are the same.

    Args:
        dataset: The data set, with the given cameras.
        background: Colour behind transparent pixels. [3] or None
    """

    def __init__(self, dataset: Dataset, background: np.ndarray | None):
        def read(views: Sequence[View]) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
            for view in views:
                yield datasets.load_image_8bit(view, background), datasets.load_mask(view)

        views = [view for view in dataset.train if view.mask_path is not None]
        self._usual = unexplained.of_cameras(views, read)

    def knows(self, view: View) -> bool:
        """Return True if the usual colours of a view's camera are known. Reads no file."""
        return view.camera.name in self._usual

    def of(self, view: View, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray | None:
        """Return the explained pixels of a view; None if it has no mask or its camera is unknown. [H, W] bool

        Args:
            view: The view.
            image: Its image, sRGB in [0, 1], in the colours of the given camera. [H, W, 3]
            mask: Its object ids, or None. [H, W]
        """
        if mask is None or not self.knows(view):
            return None
        blocks = self._usual[view.camera.name].blocks(images.to_uint8(image), mask)
        return ~unexplained.enlarged(blocks, view.camera.height, view.camera.width)
