"""Back-to-front order of Gaussians, sorted by 16-bit depth keys (numpy's stable sort of uint16 is a radix sort)."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

LEVELS = 65535
MARGIN = 1.25  # factor on both ends of the depth range, so that moving Gaussians stay inside it
WORTHWHILE = 0.5  # minimum share of unmoved Gaussians for which reusing their order is faster than sorting all


@dataclass(frozen=True)
class DepthKeys:
    """Conversion of depths to keys, the nearest Gaussian having the largest key.

    Perspective keys are the leading bits of the float32 depth, so their relative resolution is the same at all depths.
    Parallel keys are linear.

    Attributes:
        low: Smallest depth with a key of its own.
        high: Largest one.
        near: Depth at which a perspective view begins.
        parallel: True for orthographic views.
    """

    low: float
    high: float
    near: float
    parallel: bool

    @classmethod
    def of(cls, depths: np.ndarray, near: float, parallel: bool) -> DepthKeys:
        """Return a conversion for some depths, with a margin for motion that is likely to follow. [n]"""
        low, high = float(depths.min()), float(depths.max())
        if parallel:
            margin = (MARGIN - 1) * max(high - low, 1e-6)
            return cls(low - margin, high + margin, near, True)
        low = max(low, near)
        return cls(max(low / MARGIN, near), max(high, low) * MARGIN, near, False)

    def hold(self, depths: np.ndarray) -> bool:
        """Return True if all visible depths have keys of their own. [n]"""
        low = float(depths.min())
        if not self.parallel and low < self.near:  # culled
            low = float(depths.min(where=depths >= self.near, initial=np.inf))
        return low >= self.low and float(depths.max()) <= self.high

    def __call__(self, depths: np.ndarray) -> np.ndarray:
        """Convert float32 depths, which are overwritten, to keys. [n] uint16"""
        np.clip(depths, self.low, self.high, out=depths)
        if self.parallel:
            depths -= np.float32(self.high)
            depths *= np.float32(-LEVELS / (self.high - self.low))
            return depths.astype(np.uint16)
        first, last = np.array([self.low, self.high], np.float32).view(np.int32)
        shift = max(int(last - first).bit_length() - 16, 0)
        bits = depths.view(np.int32)
        np.subtract(last, bits, out=bits)
        bits >>= shift
        return bits.astype(np.uint16)


@dataclass(frozen=True)
class _Sorted:
    """Sorted Gaussians of some groups.

    Attributes:
        groups: The groups.
        conversion: Conversion of their depths.
        keys: Keys in the order of the groups. [n] uint16
        order: Indices that sort the keys, from far to near. [n] int64
        rows: Rows in that order. [n] int64
    """

    groups: frozenset[int]
    conversion: DepthKeys
    keys: np.ndarray
    order: np.ndarray
    rows: np.ndarray

    @functools.cached_property
    def sorted_keys(self) -> np.ndarray:
        """Ascending keys. [n] uint16"""
        return self.keys[self.order]


class DepthOrder:
    """Order of the Gaussians in one view. Groups that did not move keep their order, and the others are merged into it.

    Args:
        positions: Centres in the frames of their groups. [N, 3] float32
        starts: First row of each group, and N. [G + 1]
    """

    def __init__(self, positions: np.ndarray, starts: Sequence[int]):
        self._positions, self._starts = positions, starts
        self._view: tuple[float, bool] | None = None
        self._planes: dict[int, tuple[bytes, int]] = {}
        self._still: _Sorted | None = None

    def update(
        self, planes: dict[int, np.ndarray], near: float, parallel: bool, versions: Mapping[int, int] = {}
    ) -> np.ndarray:
        """Sort the Gaussians of the visible groups.

        Args:
            planes: Visible groups; depth of a point (x, y, z) is plane . (x, y, z, 1). [4] each
            near: Depth at which a perspective view begins.
            parallel: True for orthographic views.
            versions: Number of each group that increases if its positions change; by default they never do.

        Returns:
            Rows of the Gaussians, from far to near. [n] int64
        """
        if self._view != (near, parallel):  # the stored keys belong to another near plane or projection
            self._view, self._planes, self._still = (near, parallel), {}, None
        now = {group: (plane.tobytes(), versions.get(group, 0)) for group, plane in planes.items()}
        unmoved = frozenset(group for group, plane in now.items() if self._planes.get(group) == plane)
        self._planes = now
        moved = now.keys() - unmoved
        if not moved and self._still is not None and self._still.groups == now.keys():
            return self._still.rows
        least = max(WORTHWHILE * self._count(now), 1)
        if self._still is None or not self._still.groups <= unmoved:
            self._still = self._sort(planes, unmoved, near, parallel) if self._count(unmoved) >= least else None
        if self._still is not None and self._count(self._still.groups) >= least:
            merged = self._merge(planes, self._still)
            if merged is not None:
                return merged
        everything = self._sort(planes, frozenset(now), near, parallel)
        self._still = everything
        return everything.rows

    def _count(self, groups) -> int:
        return sum(self._starts[group + 1] - self._starts[group] for group in groups)

    def _depths(self, planes: dict[int, np.ndarray], groups: Sequence[int]) -> np.ndarray:
        """Depths of the Gaussians of groups. [n] float32"""
        depths, filled = np.empty(self._count(groups), np.float32), 0
        for group in groups:
            start, stop = self._starts[group], self._starts[group + 1]
            part, plane = depths[filled : filled + stop - start], planes[group]
            np.dot(self._positions[start:stop], plane[:3].astype(np.float32), out=part)
            part += np.float32(plane[3])
            filled += stop - start
        return depths

    def _rows(self, groups: Sequence[int], order: np.ndarray) -> np.ndarray:
        """Rows of the Gaussians of ascending groups, in an order. [n] int64"""
        if len(order) == self._starts[-1]:  # of all groups
            return order
        spans = [np.arange(self._starts[group], self._starts[group + 1]) for group in groups]
        return np.concatenate(spans)[order] if spans else order

    def _sort(self, planes: dict[int, np.ndarray], groups: frozenset[int], near: float, parallel: bool) -> _Sorted:
        depths = self._depths(planes, sorted(groups))
        if not len(depths):
            return _Sorted(groups, DepthKeys(near, near, near, False), *[np.empty(0, np.int64)] * 3)
        conversion = DepthKeys.of(depths, near, parallel)
        keys = conversion(depths)
        order = np.argsort(keys, kind="stable")
        return _Sorted(groups, conversion, keys, order, self._rows(sorted(groups), order))

    def _merge(self, planes: dict[int, np.ndarray], still: _Sorted) -> np.ndarray | None:
        """Merge the other groups into a sorted set, or return None if they leave its range of depths."""
        moved = sorted(planes.keys() - still.groups)
        depths = self._depths(planes, moved)
        if not len(depths):
            return still.rows
        if not still.conversion.hold(depths):
            return None
        keys = still.conversion(depths)
        order = np.argsort(keys, kind="stable")
        runs = np.concatenate([still.sorted_keys, keys[order]], dtype=np.int32)
        # numpy sorts int32 stably by merging ascending runs, which is faster than its radix sort of uint16.
        return np.concatenate([still.rows, self._rows(moved, order)])[np.argsort(runs, kind="stable")]
