"""Leave-one-out overlap of segments with objects, by the votes of the other images.

A Gaussian votes for an object with the share of its weight in segments of that object. Segments of the evaluated image
have no vote, and Gaussians that appear in no other image are ignored.

Notation: S segments of all images, s of one image, N Gaussians, K objects, 0 = background.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from . import segment_stack

MIN_WEIGHT = 1e-3  # minimum weight of a voting Gaussian in other images, pixels


@dataclass(frozen=True)
class Overlaps:
    """Overlap of an image's segments with the objects, as voted by the other images.

    Attributes:
        common: Weight in both segment and object. [s, K + 1]
        segments: Weight of each segment's Gaussians that other images show. [s]
        objects: Weight of each object in the image. [K + 1]
    """

    common: np.ndarray
    segments: np.ndarray
    objects: np.ndarray

    @property
    def ious(self) -> np.ndarray:
        """Intersection over union. [s, K + 1]"""
        union = self.segments[:, None] + self.objects[None] - self.common
        return self.common / np.maximum(union, 1e-9)

    @property
    def shares(self) -> np.ndarray:
        """Share of each segment that lies in each object. [s, K + 1]"""
        return self.common / np.maximum(self.segments[:, None], 1e-9)


def cast(stack: segment_stack.SegmentStack, labels: np.ndarray, count: int) -> sparse.csr_matrix:
    """Sum the weights of segments by object.

    Args:
        labels: Object of each segment, 0 = background, -1 = no vote. [S]
        count: Number of objects, K.

    Returns:
        Votes of all images. [N, K + 1]
    """
    rows = np.flatnonzero(labels >= 0)
    member = sparse.csr_matrix((np.ones(len(rows), np.float32), (labels[rows], rows)), (count + 1, len(labels)))
    return sparse.csr_matrix((member @ stack.weights).T)


def overlaps(stack: segment_stack.SegmentStack, labels: np.ndarray, count: int) -> Iterator[Overlaps]:
    """Yield the leave-one-out overlaps of each image; arguments as in `cast`."""
    ends = np.searchsorted(stack.images, np.arange(len(stack.views) + 1))
    for start, stop, (seen, shares) in zip(ends, ends[1:], left_out(stack, labels, count), strict=False):
        own = stack.weights[start:stop][:, seen]
        known = np.diff(shares.indptr) > 0
        yield Overlaps(
            common=sparse.csr_matrix(own @ shares).toarray().astype(float),
            segments=np.asarray(own @ known.astype(np.float32), float).ravel(),
            objects=np.asarray(shares.T @ np.asarray(own.sum(axis=0)).ravel(), float).ravel(),
        )


def left_out(
    stack: segment_stack.SegmentStack, labels: np.ndarray, count: int
) -> Iterator[tuple[np.ndarray, sparse.csr_matrix]]:
    """Yield the objects of each image's Gaussians by the votes of all other images; arguments as in `cast`.

    Yields:
        Gaussians that the image shows [n], and their shares of background and the objects, 0 for Gaussians that no
        other image shows [n, K + 1].
    """
    votes = cast(stack, labels, count)
    ends = np.searchsorted(stack.images, np.arange(len(stack.views) + 1))
    for start, stop in zip(ends, ends[1:], strict=False):
        own = stack.weights[start:stop]
        seen = np.unique(own.indices)
        said = labels[start:stop]
        voting = np.flatnonzero(said >= 0)
        member = sparse.csr_matrix(
            (np.ones(len(voting), np.float32), (np.arange(len(voting)), said[voting])), (len(voting), count + 1)
        )
        others = sparse.csr_matrix(votes[seen] - own[voting][:, seen].T @ member)
        others.data = np.maximum(others.data, 0.0)
        total = np.asarray(others.sum(axis=1)).ravel()
        others.data[np.repeat(total <= MIN_WEIGHT, np.diff(others.indptr))] = 0.0
        others.eliminate_zeros()
        others.data /= np.repeat(total, np.diff(others.indptr))
        yield seen, others
