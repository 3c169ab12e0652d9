"""Median over time of the pixels of one camera that count, computed in bands to save memory."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

VALUES = 1 << 23  # values per sorted band


def median(images: Sequence[np.ndarray], free: np.ndarray) -> np.ndarray:
    """Return the median of the free pixels, 0 if a pixel is never free.

    Args:
        images: F images. [H, W, C] uint8
        free: Mask of the pixels that count. [F, H, W] bool

    Returns:
        Values of 255 as 1. [H, W, C] float32
    """
    count, height, width = free.shape
    channels = images[0].shape[2]
    result = np.zeros((height, width, channels), np.float32)
    rows = max(1, VALUES // (channels * count * width))
    for top in range(0, height, rows):
        band = slice(top, top + rows)
        values = np.stack([image[band] for image in images]).astype(np.int16)
        values[~free[:, band]] = 256  # sorts after all colours
        values.sort(axis=0)
        free_count = free[:, band].sum(0)
        low, high = (
            np.take_along_axis(values, np.broadcast_to(k[None, ..., None], (1, *values.shape[1:])), 0)[0]
            for k in (np.maximum(free_count - 1, 0) // 2, np.minimum(free_count // 2, count - 1))
        )
        middle = (low + high).astype(np.float32) / np.float32(510)
        result[band] = np.where((free_count > 0)[..., None], middle, np.float32(0))
    return result
