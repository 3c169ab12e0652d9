"""Segments of masks as weighted bags of Gaussians.

A Gaussian keeps its index at every time and in every view, so what a segment shows can be compared between any two
images: it is the Gaussians that its pixels show, with the weights they have there.

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
    """The segments of one image, background among them.

    Attributes:
        ids: Incoming id of each segment, ascending, 0 = background. [S] int32
        pixels: Size of each. [S] int64
        weights: Weight of each Gaussian in each segment, in pixels. [S, N] float32, CSR
        view: What the ids belong to: the tracker numbered all images of one view together.
        time: Order of the images of a view.
    """

    ids: np.ndarray
    pixels: np.ndarray
    weights: sparse.csr_matrix
    view: int
    time: float


def from_pixels(
    mask: np.ndarray, indices: np.ndarray, weights: np.ndarray, count: int, *, view: int, time: float
) -> ImageBags:
    """Reduce the Gaussians of an image's pixels to one bag per segment.

    Args:
        mask: Incoming ids, 0 = background; pixels that are `masks.UNKNOWN` are left out. [H, W] or [P]
        indices: Gaussians with most weight in each pixel, -1 for none. [P, k]
        weights: Their blending weights. [P, k]
        count: Number of Gaussians, N.
        view: Group of images with common ids.
        time: Place in the order of the view's images.
    """
    mask = mask.reshape(-1)
    if indices.shape != weights.shape or len(indices) != len(mask):
        raise ValueError(f"expected {len(mask)} pixels, got indices {indices.shape} and weights {weights.shape}")
    ids, segment, pixels = np.unique(mask, return_inverse=True, return_counts=True)
    known = ids != masks.UNKNOWN
    used = (indices >= 0) & (weights > 0) & known[segment][:, None]
    rows = np.broadcast_to(segment[:, None], indices.shape)[used]
    # By Gaussian first: each is in few segments, so that equal entries are found in short rows.
    by_gaussian = sparse.coo_matrix((weights[used].astype(np.float32), (indices[used], rows)), (count, len(ids)))
    bags = by_gaussian.tocsr().T.tocsr()[np.flatnonzero(known)]
    return ImageBags(ids[known].astype(np.int32), pixels[known], bags, view, time)


@dataclass(frozen=True)
class Stack:
    """The segments of all images, one below the other.

    Attributes:
        ids: Incoming ids. [S]
        images: Image of each, ascending. [S]
        views: View of each image. [I]
        times: Time of each image. [I]
        pixels: Size of each. [S]
        weights: `ImageBags.weights`. [S, N]
        shared: Weights over the root of what the image gives the Gaussian: products of rows of different images are
            common weights, see `stack`. [S, N]
        seen: Root of what each image gives each Gaussian. [I, N]
    """

    ids: np.ndarray
    images: np.ndarray
    views: np.ndarray
    times: np.ndarray
    pixels: np.ndarray
    weights: sparse.csr_matrix
    shared: sparse.csr_matrix
    seen: sparse.csr_matrix


def stack(bags: Sequence[ImageBags]) -> Stack:
    """Put the segments of all images one below the other.

    Two images seldom give a Gaussian the same weight. What they have in common is taken as the geometric mean
    sqrt(v_i v_j) of their weights v, divided among the segments of either as the Gaussian is: for rows x_s = b_s /
    sqrt(v_i), the weight that segments s and t have in common is the product x_s . x_t, and that of s which t's image
    sees at all is x_s . sqrt(v_j).
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
    return Stack(
        ids=np.concatenate([image.ids for image in bags]),
        images=images,
        views=np.array([image.view for image in bags]),
        times=np.array([image.time for image in bags], float),
        pixels=np.concatenate([image.pixels for image in bags]),
        weights=weights,
        shared=sparse.csr_matrix(sparse.vstack(shared, "csr")),
        seen=sparse.csr_matrix(sparse.vstack(seen, "csr")),
    )
