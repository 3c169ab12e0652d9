"""Overlap of tracklets, as evidence that two of them show the same object.

Only pairs of tracklets that share Gaussians are stored. Everything else is computed for the pairs that are needed.

Notation: T tracklets, I images, P pairs of tracklets that share Gaussians.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from . import segment_stack

CHUNK = 2**20  # maximum number of values that are computed at once
ROWS = 512  # tracklets that are compared with all others at once
IMAGES = 256  # images that are compared with all tracklets at once


@dataclass(frozen=True)
class TrackletOverlaps:
    """Overlaps of tracklets, summed over the pairs of their images.

    Attributes:
        common: Weight of Gaussians in two tracklets, the first one less than the second. [T, T] CSR, P values float32
        own: Weight of Gaussians that a tracklet's images have in common. [T]
        visible: Weight of each tracklet's Gaussians that each image shows. [T, I] float32
        images: 1 for the images of each tracklet. [T, I] CSR
        pixels: Mean segment size of each tracklet. [T]
        views: View of each tracklet. [T]
        ids: Incoming id of each tracklet. [T]
    """

    common: sparse.csr_matrix
    own: np.ndarray
    visible: np.ndarray
    images: sparse.csr_matrix
    pixels: np.ndarray
    views: np.ndarray
    ids: np.ndarray

    @functools.cached_property
    def lengths(self) -> np.ndarray:
        """Number of images of each tracklet. [T]"""
        return np.diff(self.images.indptr)

    @functools.cached_property
    def view_index(self) -> np.ndarray:
        """Index of each tracklet's view among all views in ascending order. [T]"""
        return np.unique(self.views, return_inverse=True)[1]

    @functools.cached_property
    def shown(self) -> np.ndarray:
        """Mask of the images of each tracklet. [T, I] bool"""
        return self.images.toarray() > 0

    @functools.cached_property
    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Tracklets of each pair that shares Gaussians, in the order of the values of `common`. [P], [P] int32"""
        return np.repeat(np.arange(len(self.views), dtype=np.int32), np.diff(self.common.indptr)), self.common.indices

    @functools.cached_property
    def union(self) -> np.ndarray:
        """Weight in either tracklet of each pair that is visible in the other's images. [P] float32"""
        result = np.empty(self.common.nnz, np.float32)
        for some, rows, columns in self.chunks():
            result[some] = self.seen(rows, columns) - self.common.data[some]
        return result

    @functools.cached_property
    def ious(self) -> np.ndarray:
        """IoU of each pair where both are visible; 0 if an image shows both. [P] float32"""
        result = np.float32(self.common.data) / np.maximum(self.union, np.float32(1e-9))
        for some, rows, columns in self.chunks():
            result[some] *= self.together(rows, columns) == 0
        return result

    def chunks(self) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Yield parts of the pairs that share Gaussians: their place among all, and both tracklets."""
        rows, columns = self.pairs
        for start in range(0, len(rows), CHUNK):
            some = slice(start, start + CHUNK)
            yield some, rows[some], columns[some]

    def common_of(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Weight of Gaussians in both of two tracklets. [M], [M] -> [M]"""
        found = self.common[np.minimum(rows, columns), np.maximum(rows, columns)]
        return np.asarray(found, float).ravel()

    def seen(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Weight of two tracklets that is visible in the images of the other, summed. [M], [M] -> [M]"""
        return summed(self.visible, self.images, rows, columns) + summed(self.visible, self.images, columns, rows)

    def together(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Number of images that show both of two tracklets. [M], [M] -> [M]"""
        result = np.zeros(len(rows))
        same = np.flatnonzero(self.views[rows] == self.views[columns])
        result[same] = summed(self.shown, self.images, rows[same], columns[same])
        return result


def gather(stack: segment_stack.SegmentStack, runs: np.ndarray) -> TrackletOverlaps:
    """Sum the overlaps of segments over their tracklets.

    Args:
        runs: Tracklet of each segment, -1 for background. [S]
    """
    rows = np.flatnonzero(runs >= 0)
    count, images = int(runs.max(initial=-1)) + 1, len(stack.views)
    ones = np.ones(len(rows), np.float32)
    shared = sparse.csr_matrix(sparse.csr_matrix((ones, (runs[rows], rows)), (count, len(runs))) @ stack.shared)
    visible = np.empty((count, images), np.float32)
    for start in range(0, images, IMAGES):
        some = slice(start, start + IMAGES)
        visible[:, some] = (shared @ stack.seen[some].T).toarray()
    common = [
        sparse.triu(shared[start : start + ROWS] @ shared.T, start + 1, format="csr") for start in range(0, count, ROWS)
    ]
    first = rows[np.unique(runs[rows], return_index=True)[1]]
    found = TrackletOverlaps(
        common=sparse.csr_matrix(sparse.vstack(common, "csr")) if common else sparse.csr_matrix((0, 0)),
        own=np.asarray(shared.multiply(shared).sum(axis=1), float).ravel(),
        visible=visible,
        images=sparse.csr_matrix((ones, (runs[rows], stack.images[rows])), (count, images)),
        pixels=np.bincount(runs[rows], stack.pixels[rows], count) / np.maximum(np.bincount(runs[rows]), 1),
        views=stack.views[stack.images[first]],
        ids=stack.ids[first],
    )
    found.common.sort_indices()
    return found


def summed(table: np.ndarray, images: sparse.csr_matrix, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Sum the values of rows over the images of columns: elements of ``table @ images.T``.

    Args:
        table: A value for each row and image. [T, I]
        images: Weight of each image for each column; no row is empty. [T, I]
        rows, columns: Elements to compute. [M], [M]

    Returns:
        The sums. [M] float64
    """
    counts = np.diff(images.indptr)[columns]
    result = np.zeros(len(rows))
    for some in batches(counts, CHUNK):
        of, at = ragged(counts[some])
        at += images.indptr[columns[some]][of]
        result[some] = np.bincount(
            of, table[rows[some][of], images.indices[at]] * images.data[at], some.stop - some.start
        )
    return result


def batches(counts: np.ndarray, most: int) -> Iterator[slice]:
    """Yield slices of consecutive items whose counts add up to ``most`` or less, or of one larger item. [M]"""
    ends = np.cumsum(counts)
    start = 0
    while start < len(counts):
        stop = max(int(np.searchsorted(ends, ends[start] - counts[start] + most, "right")), start + 1)
        yield slice(start, stop)
        start = stop


def ragged(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each item's index as often as it counts, and numbers from 0 for each item. [M] -> two arrays [sum]"""
    of = np.repeat(np.arange(len(counts)), counts)
    return of, np.arange(len(of)) - np.repeat(np.cumsum(counts) - counts, counts)
