"""Static Gaussians of a fixed camera, rasterized once; moving Gaussians are drawn into the result frame by frame.

Tiles that no moving Gaussian touches are copied. In all others, the static and the moving lists, each sorted once, are
merged by depth and blended again. The result is bit-identical to rasterizing everything, for any depth order. Static
Gaussians cost only the merge and the blend of the touched tiles.
"""

from __future__ import annotations

import threading

import numpy as np

from ...scene.cameras import Camera
from .. import checks
from ..arrays import Array, like, to_array
from ..settings import RasterSettings, SplatImage
from ..thread_pool import run
from . import blend, forward, projection
from . import tiles as cpu_tiles

_NOTHING = np.empty((0, 0), np.float32)


class StaticLayer:
    """Static Gaussians, rendered once for one camera, without gradients.

    Args:
        means, quats, scales, opacities, channels, camera, background: As for `rasterize_splats`; copied.
        labels: As there; required for both the static and the moving Gaussians, or for neither. [N]
        ranks: Increasing index of each Gaussian among all, which breaks ties of depth. None puts them before all
            moving Gaussians. [N]
        settings: As there.

    Raises:
        ValueError: As for `rasterize_splats`.
    """

    def __init__(
        self,
        means: Array,  # [N, 3]
        quats: Array,  # [N, 4]
        scales: Array,  # [N, 3]
        opacities: Array,  # [N]
        channels: Array,  # [N, D]
        camera: Camera,
        background: Array | None = None,  # [D] or [H, W, D]
        *,
        labels: Array | None = None,  # [N]
        ranks: np.ndarray | None = None,  # [N]
        settings: RasterSettings | None = None,
    ):
        checks.check_splats(means, quats, scales, opacities, channels, camera, background, labels)
        settings = settings or RasterSettings()
        self._lock = threading.Lock()
        self._camera = camera
        self._view, self._limits = forward.pack_view(camera, settings), forward.pack_limits(settings)
        self._background = forward.pack_background(to_array(background), channels.shape[1]).copy()
        # Rows of the tables: static Gaussians, padding, moving Gaussians.
        n, rows = len(means), projection.padded_rows(len(means))
        self._count = self._end = rows
        self._geometry = forward.aligned((rows, projection.GEOMETRY), np.float64)
        self._depths, self._boxes, self._radii = np.empty(rows), np.empty(rows), np.empty(rows, np.float32)
        self._channels = np.zeros((rows, channels.shape[1]), np.float32)
        self._channels[:n] = to_array(channels)
        self._ranks = np.zeros(rows, np.int64)
        self._ranks[:n] = np.arange(n) - n if ranks is None else ranks
        self._labels = None
        if labels is not None:
            self._labels = np.full(rows, -1, np.int64)
            self._labels[:n] = forward.to_numbers(to_array(labels))
        shapes = [to_array(t) for t in (means, quats, scales, opacities)]
        forward.project(self._view, shapes, self._geometry, self._depths, self._boxes, self._radii)
        self._starts, self._rows = self._assign(0, rows)
        self._names, self._votes = forward.pack_labels(self._labels)
        size = (camera.height, camera.width)
        self._image = np.empty((*size, channels.shape[1]), np.float32)
        self._alpha, self._depth = np.empty(size, np.float32), np.empty(size, np.float32)
        self._ids = np.full(size if labels is not None else (0, 0), -1, np.int32)
        everywhere = np.arange(len(self._starts) - 1)
        self._blend(everywhere, self._starts, self._rows, (self._image, self._alpha, self._depth, self._ids))

    def draw(
        self,
        means: Array,  # [M, 3]
        quats: Array,  # [M, 4]
        scales: Array,  # [M, 3]
        opacities: Array,  # [M]
        channels: Array,  # [M, D]
        labels: Array | None = None,  # [M]
        ranks: np.ndarray | None = None,  # [M]
    ) -> SplatImage:
        """Draw moving Gaussians into the static layer. Thread-safe; concurrent calls are serialized.

        Args:
            means, quats, scales, opacities, channels: As for `rasterize_splats`.
            labels: As there; required if and only if the static layer has labels. [M]
            ranks: Increasing index of each Gaussian among all. None puts them after all static Gaussians. [M]

        Returns:
            The output of `rasterize_splats` for all Gaussians in the order of their ranks, without gradients.

        Raises:
            ValueError: As for `rasterize_splats`; the static layer stays unchanged.
        """
        checks.check_splats(means, quats, scales, opacities, channels, self._camera, None, labels)
        expected = self._channels.shape[1]
        if channels.shape[1] != expected:
            raise ValueError(f"channels: expected {expected} as in the static layer, got {channels.shape[1]}")
        if (labels is None) != (self._labels is None):
            raise ValueError("labels: expected for static and moving Gaussians, or for neither")
        numbers = None if labels is None else forward.to_numbers(to_array(labels))
        shapes = [to_array(t) for t in (means, quats, scales, opacities)]
        with self._lock:
            self._place(shapes, to_array(channels), numbers, np.arange(len(means)) if ranks is None else ranks)
            moving_starts, moving_rows = self._assign(self._count, self._end)
            touched = np.flatnonzero(np.diff(moving_starts))
            starts, merged = self._merge(touched, moving_starts, moving_rows)
            results = tuple(array.copy() for array in (self._image, self._alpha, self._depth, self._ids))
            self._blend(touched, starts, merged, results)
        image, alpha, depth, ids = (like(result, means) for result in results)
        return SplatImage(image, alpha, depth, None if labels is None else ids)

    def _place(self, shapes, channels, numbers, ranks) -> None:
        """Write moving Gaussians to the tables, after the static ones."""
        begin, n = self._count, len(channels)
        self._end = begin + projection.padded_rows(n)
        if self._end > len(self._geometry):
            self._make_room()
        part = slice(begin, self._end)
        forward.project(
            self._view, shapes, self._geometry[part], self._depths[part], self._boxes[part], self._radii[part]
        )  # fmt: skip
        self._channels[begin : begin + n] = channels
        self._ranks[begin : begin + n] = ranks
        if self._labels is not None and not np.array_equal(self._labels[begin : begin + n], numbers):
            self._labels[begin : begin + n] = numbers
            self._names, self._votes = forward.pack_labels(self._labels)

    def _make_room(self) -> None:
        """Enlarge the tables to ``self._end`` rows."""

        def longer(table, fill):
            result = np.full((self._end, *table.shape[1:]), fill, table.dtype)
            result[: self._count] = table[: self._count]
            return result

        geometry = forward.aligned((self._end, projection.GEOMETRY), np.float64)
        geometry[: self._count] = self._geometry[: self._count]
        self._geometry = geometry
        self._depths, self._boxes = longer(self._depths, 1.0), longer(self._boxes, 0.0)
        self._radii, self._channels = longer(self._radii, 0), longer(self._channels, 0)
        self._ranks = longer(self._ranks, 0)
        if self._labels is not None:
            self._labels = longer(self._labels, -1)
            self._names, self._votes = forward.pack_labels(self._labels)

    def _assign(self, begin: int, end: int) -> tuple[np.ndarray, np.ndarray]:
        """Assign rows to tiles: start of each tile's pairs, and row of each pair."""
        order = cpu_tiles.sort_by_depth(self._depths[begin:end], self._radii[begin:end]) + np.int32(begin)
        starts, rows, _, _ = cpu_tiles.assign_tiles(
            order, self._boxes, self._geometry, self._camera.width, self._camera.height, False
        )
        return starts, rows

    def _merge(self, tiles, moving_starts, moving_rows):
        """Merge static and moving pairs of some tiles: start of each tile's pairs, and row of each pair."""
        still = np.stack([self._starts[tiles], self._starts[tiles + 1]], 1)
        moving = np.stack([moving_starts[tiles], moving_starts[tiles + 1]], 1)
        starts = np.zeros(len(tiles) + 1, np.int64)
        np.cumsum(still[:, 1] - still[:, 0] + moving[:, 1] - moving[:, 0], out=starts[1:])
        merged = np.empty(starts[-1], np.int32)
        run(
            cpu_tiles.merge_pairs, len(tiles) // 8,
            self._depths, self._ranks, still, self._rows, moving, moving_rows, starts, merged,
        )  # fmt: skip
        return starts, merged

    def _blend(self, tiles, starts, rows, results) -> None:
        image, alpha, depth, ids = results
        run(
            blend.blend, len(tiles) // 2,
            tiles, starts, rows, self._geometry, self._channels, self._depths, self._votes, self._names,
            self._background, self._limits, image, alpha, depth, _NOTHING, _NOTHING, ids,
            np.empty(len(tiles), np.int64), np.empty(len(rows), np.uint64),
        )  # fmt: skip
