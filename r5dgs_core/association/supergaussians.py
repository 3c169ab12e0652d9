"""Patches of neighbouring Gaussians that move together, which bound the cost of association.

Notation: N Gaussians, k neighbours, T times, G patches.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

APART = 0.1  # maximum growth of the distance of two neighbours beyond its minimum, as a share of their travel
ROUNDS = 12  # maximum number of seeding rounds


def group(count: int, neighbours: np.ndarray | None, paths: np.ndarray | None, most: int) -> np.ndarray:
    """Group neighbouring Gaussians into patches; a patch is a Gaussian and at most all of its neighbours.

    Args:
        count: Number of Gaussians, N.
        neighbours: Nearest Gaussians of each Gaussian; None keeps a random sample of single Gaussians. [N, k]
        paths: Positions at some times. [N, T, 3]
        most: Size of the sample without neighbours; the number of patches is not bounded.

    Returns:
        Patch of each Gaussian, -1 for those left out. [N]
    """
    rng = np.random.default_rng(0)
    if neighbours is None:
        labels = np.full(count, -1)
        labels[rng.permutation(count)[:most]] = np.arange(min(most, count))
        return labels
    together = _together(neighbours, paths)
    priority = rng.permutation(count)
    labels = np.full(count, -1)
    for _ in range(ROUNDS):
        free = labels < 0
        if not free.any():
            break
        # A free Gaussian whose priority exceeds that of its free neighbours starts a patch with them.
        around = np.where(free[neighbours] & together, priority[neighbours], -1)
        seeds = np.flatnonzero(free & (priority > around.max(axis=1)))
        labels[seeds] = seeds
        taken = (free[neighbours[seeds]]) & together[seeds] & (labels[neighbours[seeds]] < 0)
        labels[neighbours[seeds][taken]] = np.broadcast_to(seeds[:, None], taken.shape)[taken]
    labels = np.where(labels < 0, np.arange(count), labels)
    return np.unique(labels, return_inverse=True)[1]


def pool(weights: sparse.csr_matrix, groups: np.ndarray) -> sparse.csr_matrix:
    """Sum the weights of segments over the Gaussians of each patch. [S, N] -> [S, G]"""
    count = int(groups.max()) + 1
    kept = groups[weights.indices]
    rows = np.repeat(np.arange(len(weights.indptr) - 1), np.diff(weights.indptr))
    keep = kept >= 0
    flat = rows[keep] * np.int64(count) + kept[keep]
    cells, at = np.unique(flat, return_inverse=True)
    sums = np.bincount(at, weights.data[keep], minlength=len(cells)).astype(np.float32)
    return sparse.csr_matrix((sums, (cells // count, cells % count)), (len(weights.indptr) - 1, count))


def _together(neighbours: np.ndarray, paths: np.ndarray | None) -> np.ndarray:
    """Mask of the neighbours whose distance stays nearly constant. [N, k] bool"""
    if paths is None or paths.shape[1] < 2:
        return np.ones(neighbours.shape, bool)
    travel = np.linalg.norm(paths - paths[:, :1], axis=-1).max(axis=1)
    out = np.empty(neighbours.shape, bool)
    for column in range(neighbours.shape[1]):
        apart = np.linalg.norm(paths - paths[neighbours[:, column]], axis=-1)
        change = apart.max(axis=1) - apart.min(axis=1)
        out[:, column] = change <= APART * np.maximum(travel, travel[neighbours[:, column]]) + apart.min(axis=1)
    return out
