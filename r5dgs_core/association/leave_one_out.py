"""What the other images say about a segment: leave-one-out overlap with each object.

A Gaussian belongs to an object by the share of its weight that lies in segments of that object. When an image is
judged its own segments have no vote, and Gaussians that no other image shows are no evidence for or against.

Notation: S segments of all images, s of one image, N Gaussians, K objects, 0 = background.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from . import segment_stack

LEAST = 1e-3  # weight in other images, in pixels, below which a Gaussian is no evidence


@dataclass(frozen=True)
class Overlaps:
    """Overlap of segments with objects as the other images see these.

    Attributes:
        common: Weight that segment and object have in common. [s, K + 1]
        segments: Weight of each segment that other images know. [s]
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


def cast(stack: segment_stack.Stack, labels: np.ndarray, count: int) -> sparse.csr_matrix:
    """Sum the weights of segments by object.

    Args:
        stack: The segments.
        labels: Object of each, 0 = background, -1 = none: it does not vote. [S]
        count: Number of objects, K.

    Returns:
        Votes of all images. [N, K + 1]
    """
    rows = np.flatnonzero(labels >= 0)
    member = sparse.csr_matrix((np.ones(len(rows), np.float32), (labels[rows], rows)), (count + 1, len(labels)))
    return sparse.csr_matrix((member @ stack.weights).T)


def overlaps(stack: segment_stack.Stack, labels: np.ndarray, count: int) -> Iterator[Overlaps]:
    """Leave-one-out overlaps image by image; arguments as of `cast`."""
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
    stack: segment_stack.Stack, labels: np.ndarray, count: int
) -> Iterator[tuple[np.ndarray, sparse.csr_matrix]]:
    """What the Gaussians of each image show by the votes of all other images; arguments as of `cast`.

    Yields:
        Gaussians that the image shows [n], and their shares of background and the objects, 0 where no other image
        shows the Gaussian [n, K + 1].
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
        others.data[np.repeat(total <= LEAST, np.diff(others.indptr))] = 0.0
        others.eliminate_zeros()
        others.data /= np.repeat(total, np.diff(others.indptr))
        yield seen, others
