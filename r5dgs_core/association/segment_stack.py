"""Segments of masks as weighted bags of Gaussians.

A Gaussian keeps its index at all times and in all views. The bag of a segment, the Gaussians that its pixels show with
their weights, is therefore comparable between any two images.

Notation: N Gaussians, P pixels of an image, k Gaussians kept per pixel, S segments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ..data import masks


@dataclass(frozen=True)
class ImageBags:
    """The segments of one image, including background.

    Attributes:
        ids: Incoming id of each segment, ascending, 0 = background. [S] int32
        pixels: Size of each segment. [S] int64
        weights: Weight of each Gaussian in each segment, in pixels. [S, N] float32, CSR
        view: Scope of the ids: the tracker numbered all images of one view together.
        time: Sorting key of the images of a view.
    """

    ids: np.ndarray
    pixels: np.ndarray
    weights: sparse.csr_matrix
    view: int
    time: float


def from_pixels(
    mask: np.ndarray, indices: np.ndarray, weights: np.ndarray, count: int, *, view: int, time: float
) -> ImageBags:
    """Sum the blending weights of Gaussians over the pixels of each segment: one bag per segment.

    Args:
        mask: Incoming ids, 0 = background; pixels that are `masks.UNKNOWN` are ignored. [H, W] or [P]
        indices: Gaussians with the largest weights in each pixel, -1 for none. [P, k]
        weights: Their blending weights. [P, k]
        count: Number of Gaussians, N.
        view: Group of images with common ids.
        time: Sorting key of the image in its view.
    """
    mask = mask.reshape(-1)
    if indices.shape != weights.shape or len(indices) != len(mask):
        raise ValueError(f"expected {len(mask)} pixels, got indices {indices.shape} and weights {weights.shape}")
    ids, segment, pixels = np.unique(mask, return_inverse=True, return_counts=True)
    known = ids != masks.UNKNOWN
    used = (indices >= 0) & (weights > 0) & known[segment][:, None]
    rows = np.broadcast_to(segment[:, None], indices.shape)[used]
    # Rows by Gaussian first: a Gaussian is in few segments, so duplicates are summed quickly.
    by_gaussian = sparse.coo_matrix((weights[used].astype(np.float32), (indices[used], rows)), (count, len(ids)))
    bags = by_gaussian.tocsr().T.tocsr()[np.flatnonzero(known)]
    return ImageBags(ids[known].astype(np.int32), pixels[known], bags, view, time)


@dataclass(frozen=True)
class SegmentStack:
    """The segments of all images, concatenated. I images.

    Attributes:
        ids: Incoming ids. [S]
        images: Image of each segment, ascending. [S]
        views: View of each image. [I]
        times: Time of each image. [I]
        pixels: Size of each segment. [S]
        weights: `ImageBags.weights`. [S, N]
        shared: Weights divided by the square root of the Gaussian's total weight in the image: products of rows of
            different images are common weights, see `stack`. [S, N]
        seen: Square root of each Gaussian's total weight in each image. [I, N]
    """

    ids: np.ndarray
    images: np.ndarray
    views: np.ndarray
    times: np.ndarray
    pixels: np.ndarray
    weights: sparse.csr_matrix
    shared: sparse.csr_matrix
    seen: sparse.csr_matrix


def stack(bags: Sequence[ImageBags]) -> SegmentStack:
    """Concatenate the segments of all images.

    A Gaussian rarely has the same weight in two images. Its common weight is the geometric mean sqrt(v_i v_j) of its
    total weights v, distributed over the segments of each image like the Gaussian itself. With rows x_s = b_s /
    sqrt(v_i), the common weight of segments s and t is the product x_s . x_t, and the weight of s that is visible in
    t's image is x_s . sqrt(v_j).
    """
    count = bags[0].weights.get_shape()[1]
    for k, image in enumerate(bags):
        if image.weights.shape != (len(image.ids), count) or np.any(np.diff(image.ids) <= 0):
            raise ValueError(f"image {k}: expected ascending ids and a bag over {count} Gaussians for each of them")
    images = np.repeat(np.arange(len(bags)), [len(image.ids) for image in bags])
    weights = sparse.csr_matrix(sparse.vstack([image.weights for image in bags], "csr", np.float32))
    seen, shared = [], []
    for image in bags:
        total = np.asarray(image.weights.sum(axis=0), np.float32).ravel()
        root = np.sqrt(total)
        rows = sparse.csr_matrix(image.weights, dtype=np.float32, copy=True)
        rows.data = rows.data / np.maximum(root[rows.indices], 1e-12)
        shared.append(rows)
        at = np.flatnonzero(total).astype(np.int32)
        seen.append(sparse.csr_matrix((root[at], at, [0, len(at)]), (1, count)))
    return SegmentStack(
        ids=np.concatenate([image.ids for image in bags]),
        images=images,
        views=np.array([image.view for image in bags]),
        times=np.array([image.time for image in bags], float),
        pixels=np.concatenate([image.pixels for image in bags]),
        weights=weights,
        shared=sparse.csr_matrix(sparse.vstack(shared, "csr")),
        seen=sparse.csr_matrix(sparse.vstack(seen, "csr")),
    )
