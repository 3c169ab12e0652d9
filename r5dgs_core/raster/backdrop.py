"""What stands still before a camera that does: rasterized once, while what moves is drawn into it frame by frame.

A tile that nothing moving touches is the same in every frame, and is copied. In the others the two lists of Gaussians,
each sorted once, are merged by depth and blended anew. The result is that of rasterizing everything, to the bit, in
whatever order of depth the parts lie; what is saved is all work on still Gaussians but that.
"""

from __future__ import annotations

import numpy as np
import torch

from ..scene.cameras import Camera
from . import cpu, cpu_blending, cpu_projection, cpu_tiles, splatting
from .compile import run
from .settings import RasterSettings, SplatImage

_NOTHING = np.empty((0, 0), np.float32)


class Backdrop:
    """Gaussians that stand still, drawn once for one camera by the backend `cpu`.

    The inputs are those of `rasterize_splats`, without gradients; labels are given for both parts or for neither.
    """

    def __init__(
        self,
        means: torch.Tensor,  # [N, 3]
        quats: torch.Tensor,  # [N, 4]
        scales: torch.Tensor,  # [N, 3]
        opacities: torch.Tensor,  # [N]
        channels: torch.Tensor,  # [N, D]
        camera: Camera,
        background: torch.Tensor | None = None,  # [D] or [H, W, D]
        *,
        labels: torch.Tensor | None = None,  # [N]
        settings: RasterSettings | None = None,
    ):
        splatting.check_splats(means, quats, scales, opacities, channels, camera, background, labels)
        splatting.choose_backend("cpu", means)
        settings = settings or RasterSettings()
        self._camera = camera
        self._view, self._limits = cpu.pack_view(camera, settings), cpu.pack_limits(settings)
        self._background = cpu.pack_background(background, channels.shape[1])
        *shapes, still_channels = (_array(t) for t in (means, quats, scales, opacities, channels))
        # Rows of the tables: first what is still, padded, then what moves.
        self._count, self._room = cpu_projection.padded_rows(len(means)), 0
        self._geometry = cpu.aligned((self._count, cpu_projection.GEOMETRY), np.float64)
        self._depths, self._boxes = np.empty(self._count), np.empty(self._count)
        self._radii = np.empty(self._count, np.float32)
        self._channels = np.zeros((self._count, channels.shape[1]), np.float32)
        self._channels[: len(means)] = still_channels
        self._labels = None
        if labels is not None:
            self._labels = np.full(self._count, -1, np.int64)
            self._labels[: len(means)] = _array(labels)
        cpu.project(self._view, shapes, self._geometry, self._depths, self._boxes, self._radii)
        self._starts, self._rows = self._assign(0)
        self._names, self._votes = cpu.pack_labels(self._labels)
        size = (camera.height, camera.width)
        self._image = np.empty((*size, channels.shape[1]), np.float32)
        self._alpha, self._depth = np.empty(size, np.float32), np.empty(size, np.float32)
        self._ids = np.full(size if labels is not None else (0, 0), -1, np.int32)
        everywhere = np.arange(len(self._starts) - 1)
        self._blend(everywhere, self._starts, self._rows, (self._image, self._alpha, self._depth, self._ids))

    def draw(
        self,
        means: torch.Tensor,  # [M, 3]
        quats: torch.Tensor,  # [M, 4]
        scales: torch.Tensor,  # [M, 3]
        opacities: torch.Tensor,  # [M]
        channels: torch.Tensor,  # [M, D]
        labels: torch.Tensor | None = None,  # [M]
    ) -> SplatImage:
        """What `rasterize_splats` gives for the still Gaussians followed by these."""
        splatting.check_splats(means, quats, scales, opacities, channels, self._camera, None, labels)
        splatting.choose_backend("cpu", means)
        if channels.shape[1] != self._channels.shape[1]:
            raise ValueError(
                f"channels: expected {self._channels.shape[1]} as in the backdrop, got {channels.shape[1]}"
            )
        if (labels is None) != (self._labels is None):
            raise ValueError("labels: expected for the backdrop and for what moves, or for neither")
        *shapes, moving_channels = (_array(t) for t in (means, quats, scales, opacities, channels))
        begin, rows = self._count, cpu_projection.padded_rows(len(means))
        self._make_room(rows)
        parts = (table[begin : begin + rows] for table in (self._geometry, self._depths, self._boxes, self._radii))
        cpu.project(self._view, shapes, *parts)
        self._channels[begin : begin + len(means)] = moving_channels
        if self._labels is not None and labels is not None:
            new = _array(labels)
            if not np.array_equal(self._labels[begin : begin + len(new)], new):
                self._labels[begin : begin + len(new)] = new
                self._names, self._votes = cpu.pack_labels(self._labels)
        moving_starts, moving_rows = self._assign(begin, begin + rows)
        touched = np.flatnonzero(np.diff(moving_starts))
        starts, merged = self._merge(touched, moving_starts, moving_rows)
        results = tuple(array.copy() for array in (self._image, self._alpha, self._depth, self._ids))
        self._blend(touched, starts, merged, results)
        image, alpha, depth, ids = (torch.from_numpy(result) for result in results)
        return SplatImage(image, alpha, depth, None if self._labels is None else ids)

    def _make_room(self, rows: int) -> None:
        """Let the tables have at least that many rows for what moves."""
        if rows <= self._room:
            return

        def longer(table, fill):
            result = np.full((self._count + rows, *table.shape[1:]), fill, table.dtype)
            result[: self._count] = table[: self._count]
            return result

        geometry = cpu.aligned((self._count + rows, cpu_projection.GEOMETRY), np.float64)
        geometry[: self._count] = self._geometry[: self._count]
        self._geometry, self._room = geometry, rows
        self._depths, self._boxes = longer(self._depths, 1.0), longer(self._boxes, 0.0)
        self._radii, self._channels = longer(self._radii, 0), longer(self._channels, 0)
        if self._labels is not None:
            self._labels = longer(self._labels, -1)
            self._names, self._votes = cpu.pack_labels(self._labels)

    def _assign(self, begin: int, end: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Pairs of some rows: where those of each tile begin, and the rows."""
        order = cpu_tiles.sort_by_depth(self._depths[begin:end], self._radii[begin:end]) + np.int32(begin)
        starts, rows, _, _ = cpu_tiles.assign_tiles(
            order, self._boxes, self._geometry, self._camera.width, self._camera.height, False
        )
        return starts, rows

    def _merge(self, tiles, moving_starts, moving_rows):
        """Pairs of some tiles, still and moving ones: where those of each tile begin, and the rows."""
        spans, rows = [], []
        for all_starts, all_rows in ((self._starts, self._rows), (moving_starts, moving_rows)):
            spans.append(np.stack([all_starts[tiles], all_starts[tiles + 1]], 1))
            rows.append(all_rows)
        starts = np.zeros(len(tiles) + 1, np.int64)
        np.cumsum(sum(span[:, 1] - span[:, 0] for span in spans), out=starts[1:])
        merged = np.empty(starts[-1], np.int32)
        run(
            cpu_tiles.merge_pairs, len(tiles) // 8,
            self._depths, spans[0], rows[0], spans[1], rows[1], starts, merged,
        )  # fmt: skip
        return starts, merged

    def _blend(self, tiles, starts, rows, results) -> None:
        image, alpha, depth, ids = results
        run(
            cpu_blending.blend, len(tiles) // 2,
            tiles, starts, rows, self._geometry, self._channels, self._depths, self._votes, self._names,
            self._background, self._limits, image, alpha, depth, _NOTHING, _NOTHING, ids,
            np.empty(len(tiles), np.int64), np.empty(len(rows), np.uint64),
        )  # fmt: skip


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()
