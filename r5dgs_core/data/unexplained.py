"""Regions of fixed cameras that move although no mask names them, such as a person who carries an object.

Each fixed camera has usual colours: the median over time of its pixels outside the masks. A region is unexplained at a
time if its colours differ from the usual ones, but not by light alone: shadows and light change all channels by about
the same factor. Faint differences count if they adjoin clear ones. If the colours of a region differ most of the time,
no image shows what is behind it, and it is unexplained at all times.

Images are compared in blocks, in at most `LINES` rows, which bounds time and memory.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from scipy import ndimage

from ..scene.cameras import Camera
from ..scene.sampling import spread
from . import temporal_median

NEED = "unexplained_regions"  # row of the needs table
LINES = 180  # maximum rows of blocks of an image
MIN_FRAMES, MAX_FRAMES = 5, 31  # frames of a camera for its usual colours
LEAST, NOISE = 0.06, 5.0  # difference from the usual colours that counts: of white, and in standard deviations
TO_SIGMA = 1.4826  # standard deviation / median absolute deviation
FAINT = 0.5  # limit of faint differences relative to that of clear ones
SHADOW = 0.3  # smallest factor on the colours by shadows; its inverse is the largest one by light
DIM = 1e-4  # squared colour that counts as black
OFTEN = 0.1  # share of the frames with clear differences in a region whose colours mostly differ
MARGIN = 0.05  # dilation of the masks, relative to the rows of blocks; it keeps the outlines of objects in training
SPECK, GAP = 0.008, 0.03  # radius of removed specks and of closed gaps, relative to the rows of blocks
SMALL = 0.002  # share of the image below which a region is ignored
MOST = 0.7  # share of the image above which the camera or its colours have changed instead


@dataclass(frozen=True)
class UsualColors:
    """Usual colours of a fixed camera, in blocks.

    Attributes:
        colors: Median over time of the pixels outside the masks, 0 to 1. [h, w, 3] float32
        known: Blocks with usual colours. [h, w] bool
        limit: Difference from the usual colours that counts.
        unsteady: Blocks that are unexplained at all times. [h, w] bool
        share: Mean share of the unexplained blocks in the frames that gave the usual colours.
    """

    colors: np.ndarray
    known: np.ndarray
    limit: float
    unsteady: np.ndarray
    share: float = 0.0

    def blocks(self, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        """Return the unexplained blocks of a frame of this camera. [h, w] bool

        Args:
            image: The image. [H, W, 3] uint8
            mask: Its object ids, or None. [H, W]
        """
        return self._of_blocks(*_reduced(image, mask))

    def _of_blocks(self, small: np.ndarray, covered: np.ndarray) -> np.ndarray:
        clear, faint = _differences(small, self.colors, self.limit)
        allowed = self.known & ~covered
        found = ~covered & _cleaned(clear & allowed, (faint | self.unsteady) & allowed, self.unsteady & allowed)
        return found if found.mean() <= MOST else np.zeros_like(found)


class Seen(Protocol):
    """View of a camera."""

    @property
    def camera(self) -> Camera:
        """The camera; fixed cameras have one name at all times."""
        ...


View = TypeVar("View", bound=Seen)


def of_cameras(
    views: Sequence[View], read: Callable[[Sequence[View]], Iterable[tuple[np.ndarray, np.ndarray | None]]]
) -> dict[str, UsualColors]:
    """Return the usual colours of the fixed cameras by name.

    Args:
        views: Views with masks, of any cameras.
        read: Returns images [H, W, 3] uint8 and object ids [H, W] of some views.
    """
    groups: dict[str, list[View]] = {}
    for view in views:
        groups.setdefault(view.camera.name, []).append(view)
    found = {name: usual(read(spread(group, MAX_FRAMES))) for name, group in groups.items() if len(group) >= MIN_FRAMES}
    return {name: one for name, one in found.items() if one is not None}


def usual(frames: Iterable[tuple[np.ndarray, np.ndarray | None]]) -> UsualColors | None:
    """Return the usual colours of a fixed camera; None with fewer than `MIN_FRAMES` frames.

    Args:
        frames: Images [H, W, 3] uint8 and object ids, or None, [H, W] of at most `MAX_FRAMES` times.
    """
    small, covered = [], []
    for image, mask in frames:
        one = _reduced(image, mask)
        small.append(one[0])
        covered.append(one[1])
    if len(small) < MIN_FRAMES:
        return None
    free = ~np.stack(covered)
    colors = temporal_median.median(small, free)
    apart = [np.rint(255 * _distance(one, colors)).astype(np.uint8)[..., None] for one in small]
    deviation = temporal_median.median(apart, free)[..., 0]
    known = free.sum(0) >= MIN_FRAMES
    noise = TO_SIGMA * float(np.median(deviation[known])) if known.any() else 0.0
    limit = max(LEAST, NOISE * noise)
    clear = np.zeros(known.shape)
    for one, here in zip(small, free, strict=True):
        clear += _differences(one, colors, limit)[0] & here
    mostly = known & (deviation > FAINT * limit)
    unsteady = _cleaned(mostly & (clear > OFTEN * free.sum(0)), mostly, np.zeros_like(known))
    found = UsualColors(colors, known, limit, unsteady)
    share = np.mean([found._of_blocks(*one).mean() for one in zip(small, covered, strict=True)])
    return dataclasses.replace(found, share=float(share))


def enlarged(blocks: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return a mask of blocks as a mask of pixels. [h, w] -> [H, W] bool"""
    size = _side(height)
    for axis, length in ((1, width), (0, height)):  # several times faster than indexing
        counts = np.full(blocks.shape[axis], size)
        counts[-1] = length - size * (len(counts) - 1)
        blocks = np.repeat(blocks, counts, axis)
    return blocks


def _side(height: int) -> int:
    """Return the side of a block, px."""
    return max(1, -(-height // LINES))


def _reduced(image: np.ndarray, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean colours of blocks [h, w, 3] uint8 and the blocks that a mask covers [h, w] bool."""
    size = _side(image.shape[0])
    height, width = image.shape[0] // size, max(1, image.shape[1] // size)
    parts = image[: height * size, : width * size].reshape(height, size, width, -1, 3)
    small = np.rint(parts.mean((1, 3), dtype=np.float32)).astype(np.uint8)
    if mask is None:
        return small, np.zeros((height, width), bool)
    shown = (mask[: height * size, : width * size] > 0).reshape(height, size, width, -1).any((1, 3))
    return small, _grown(np.asarray(shown), max(1, round(MARGIN * height)))


def _distance(small: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Return the largest difference of a channel, 0 to 1. [h, w]"""
    return np.abs(small.astype(np.float32) / 255 - colors).max(-1)


def _differences(small: np.ndarray, colors: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the blocks that differ clearly, by more than light, and those that differ faintly. [h, w] bool each"""
    factor = (small / np.float32(255) * colors).sum(-1) / np.maximum((colors * colors).sum(-1), DIM)
    lit = np.clip(factor, SHADOW, 1 / SHADOW)[..., None] * colors
    apart = _distance(small, colors)
    return np.minimum(apart, _distance(small, lit)) > limit, apart > FAINT * limit


def _cleaned(clear: np.ndarray, faint: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Return the faint regions that contain clear differences, without specks and gaps, and the given regions.

    Args:
        clear: Blocks that differ clearly. [h, w] bool
        faint: Blocks that differ at least faintly. [h, w] bool
        given: Blocks that belong to the result in any case. [h, w] bool
    """
    speck, gap = (max(1, round(share * clear.shape[0])) for share in (SPECK, GAP))
    seeds = _grown(_shrunk(clear, speck), speck) | given
    if not seeds.any():
        return np.zeros_like(clear)
    labels = _pieces(_grown(_shrunk(faint | clear, speck), speck) | seeds)
    region = np.isin(labels, labels[seeds])
    closed = _shrunk(_grown(np.pad(region, gap + 1), gap), gap)[gap + 1 : -gap - 1, gap + 1 : -gap - 1]
    labels = _pieces(np.asarray(ndimage.binary_fill_holes(closed)))
    large = np.bincount(labels.ravel()) >= SMALL * clear.size
    large[0] = False
    return _grown(large[labels], speck)


def _pieces(mask: np.ndarray) -> np.ndarray:
    """Number the connected pieces of a mask from 1 on. [h, w] int32"""
    labels = np.zeros(mask.shape, np.int32)
    ndimage.label(mask, output=labels)
    return labels


def _grown(mask: np.ndarray, radius: float) -> np.ndarray:
    """Dilate a mask by a disc. [h, w] bool"""
    if not mask.any():
        return mask
    return np.asarray(ndimage.distance_transform_edt(~mask)) <= radius + 0.3


def _shrunk(mask: np.ndarray, radius: float) -> np.ndarray:
    """Erode a mask by a disc; beyond the border it goes on. [h, w] bool"""
    return ~_grown(~mask, radius)
