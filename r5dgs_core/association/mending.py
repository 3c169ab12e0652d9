"""Pixels that a relabelled segment cannot mend: objects that the tracker missed or ran together with others.

The other images' votes are drawn into the image. Outlines stay as they came; only where an object that the votes show
has no segment of its own may pixels change: inside the one segment, or the background, that most of it lies in.

Notation: H, W pixels, K objects, N Gaussians.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..data import masks
from . import associate, leave_one_out, segment_stack

TRUSTED = 0.3  # usual overlap of segments with the votes of other images below which outlines of votes are too far off
WITHIN = 0.5  # share of what the votes show of an object that must lie in one segment for it to take pixels of that
LEAST = 0.1  # share of the usual size of an object's segments that votes must show for it to take any pixel


def shares(
    images: Sequence[segment_stack.ImageBags], found: associate.Association
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """What the Gaussians of each image show by the votes of all others, to be drawn like colours.

    Yields:
        Gaussians that the image shows [n], and their shares of background and the objects [n, K + 1] float32.
    """
    stack = segment_stack.stack(images)
    names = np.concatenate([[0], found.objects])
    new = np.concatenate(found.ids)
    labels = np.where(new == masks.UNKNOWN, -1, np.searchsorted(names, new))
    for seen, part in leave_one_out.left_out(stack, labels, len(found.objects)):
        yield seen, part.toarray().astype(np.float32)


def mend(mask: np.ndarray, ids: np.ndarray, drawn: np.ndarray, found: associate.Association, image: int) -> np.ndarray:
    """New ids of an image's pixels.

    Args:
        mask: Incoming ids. [H, W]
        ids: Incoming id of each segment, `segment_stack.ImageBags.ids`. [S]
        drawn: Votes of the other images, `shares` blended like colours. [H, W, K + 1]
        found: The association.
        image: Index of the image.

    Returns:
        New ids, 0 = background, `masks.UNKNOWN` = unknown. [H, W] int32
    """
    out = relabel(mask, ids, found.ids[image])
    if not trusts(found):
        return out
    names = np.concatenate([[0], found.objects])
    shown = names[drawn.argmax(axis=-1)]  # background where nothing votes
    result = out.copy()
    for name in lacks(found, image):
        where = shown == name
        if where.sum() < LEAST * found.sizes.get(int(name), np.inf):
            continue
        segments, counts = np.unique(mask[where], return_counts=True)
        best = int(counts.argmax())
        if counts[best] >= WITHIN * counts.sum() and segments[best] != masks.UNKNOWN:
            result[where & (mask == segments[best])] = name
    return result


def trusts(found: associate.Association) -> bool:
    """Whether votes are near enough to outlines for pixels to be given away by them."""
    return not found.fallback and found.usual_iou >= TRUSTED


def lacks(found: associate.Association, image: int) -> list[int]:
    """Objects that have no segment in an image."""
    return found.objects[~np.isin(found.objects, found.ids[image])].tolist()


def relabel(mask: np.ndarray, ids: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Put the new ids of segments in place of those that they came with. [H, W] int32"""
    at = np.minimum(np.searchsorted(ids, mask), len(ids) - 1)
    return np.where(ids[at] == mask, new[at], masks.UNKNOWN).astype(np.int32)
