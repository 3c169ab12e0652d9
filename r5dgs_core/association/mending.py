"""Pixel repair beyond relabelling: objects that the tracker missed or merged with others.

The votes of the other images are rendered into the image. Outlines stay, except for objects that the votes show but
that have no segment: these take pixels from the segment or background that contains most of them.

Notation: H, W pixels, K objects, N Gaussians.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..data import masks
from . import associate, leave_one_out, segment_stack

TRUSTED = 0.3  # minimum usual IoU of segments and votes; below it, outlines of votes are too inaccurate
WITHIN = 0.5  # minimum share of an object's voted pixels inside the segment that loses pixels to it
MIN_RELATIVE_SIZE = 0.1  # minimum number of voted pixels, relative to the object's usual segment size


def shares(
    images: Sequence[segment_stack.ImageBags], found: associate.Association
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the votes of all other images for each image's Gaussians, to be rendered as channels.

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
    """Return the new ids of an image's pixels.

    Args:
        mask: Incoming ids. [H, W]
        ids: Incoming id of each segment, `segment_stack.ImageBags.ids`. [S]
        drawn: Rendered votes of the other images, see `shares`. [H, W, K + 1]
        image: Index of the image.

    Returns:
        New ids, 0 = background, `masks.UNKNOWN` = unknown. [H, W] int32
    """
    out = relabel(mask, ids, found.ids[image])
    if not trusts(found):
        return out
    names = np.concatenate([[0], found.objects])
    shown = names[drawn.argmax(axis=-1)]  # background for pixels without votes
    result = out.copy()
    for name in lacks(found, image):
        where = shown == name
        if where.sum() < MIN_RELATIVE_SIZE * found.sizes.get(int(name), np.inf):
            continue
        segments, counts = np.unique(mask[where], return_counts=True)
        best = int(counts.argmax())
        if counts[best] >= WITHIN * counts.sum() and segments[best] != masks.UNKNOWN:
            result[where & (mask == segments[best])] = name
    return result


def trusts(found: associate.Association) -> bool:
    """Return True if the votes are accurate enough to move pixels."""
    return not found.fallback and found.usual_iou >= TRUSTED


def lacks(found: associate.Association, image: int) -> list[int]:
    """Objects without a segment in an image."""
    return found.objects[~np.isin(found.objects, found.ids[image])].tolist()


def relabel(mask: np.ndarray, ids: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Replace the incoming ids of a mask by the new ids of its segments. [H, W] int32"""
    at = np.minimum(np.searchsorted(ids, mask), len(ids) - 1)
    return np.where(ids[at] == mask, new[at], masks.UNKNOWN).astype(np.int32)
