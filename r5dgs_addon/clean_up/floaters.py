"""Criteria for floaters: faint, large, isolated and distant Gaussians, relative to their object."""

from __future__ import annotations

import numpy as np

CORE_SHARE = 0.9  # share of an object's Gaussians within its radius
_CELLS = 1 << 20  # cells of the grid along an axis; points beyond are counted with the last cell


def center_and_radius(means: np.ndarray) -> tuple[np.ndarray, float]:
    """Median centre of an object and the distance from it that contains `CORE_SHARE` of its Gaussians. [n, 3]"""
    if not len(means):
        return np.zeros(3), 0.0
    center = np.median(means.astype(np.float64), axis=0)
    return center, float(np.quantile(np.linalg.norm(means - center, axis=1), CORE_SHARE))


def is_distant(means: np.ndarray, share: float) -> np.ndarray:
    """Mask of the Gaussians farther than ``share`` radii from the centre of their object. [n, 3] -> [n]"""
    center, radius = center_and_radius(means)
    return np.linalg.norm(means - center, axis=1) > share * radius


def is_large(means: np.ndarray, scales: np.ndarray, share: float) -> np.ndarray:
    """Mask of the Gaussians whose largest standard deviation exceeds ``share`` radii of their object. [n, 3] -> [n]"""
    return scales.max(1) > share * center_and_radius(means)[1]


def is_isolated(means: np.ndarray, share: float, fewest: int) -> np.ndarray:
    """Mask of the Gaussians with few neighbours.

    Args:
        means: Centres of one object. [n, 3]
        share: Size of the cells of a grid, as a share of the object's radius.
        fewest: A Gaussian is isolated if its cell and the 26 around it hold fewer other Gaussians than this.

    Returns:
        The mask. [n]
    """
    center, radius = center_and_radius(means)
    if radius * share <= 0:
        return np.zeros(len(means), bool)
    cells = np.floor((means - center) / (radius * share))
    cells = np.clip(cells, 1 - _CELLS // 2, _CELLS // 2 - 2).astype(np.int64) + _CELLS // 2
    keys, own, counts = np.unique(cells @ (1, _CELLS, _CELLS**2), return_inverse=True, return_counts=True)
    near = np.zeros(len(keys), np.int64)
    steps = (-1, 0, 1)
    for offset in (x + y * _CELLS + z * _CELLS**2 for z in steps for y in steps for x in steps):
        place = np.minimum(np.searchsorted(keys, keys + offset), len(keys) - 1)
        near += np.where(keys[place] == keys + offset, counts[place], 0)
    return near[own.reshape(-1)] - 1 < fewest
