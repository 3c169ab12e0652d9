"""Backend `cpu`: float32 kernels on any number of threads, compiled by numba, which is imported on the first call."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...scene.cameras import Camera
from ..backend import Backend, StaticLayer, ViewPoses
from ..settings import RasterSettings, RasterStats, SplatImage

_ROWS_WORTH_A_THREAD = 64  # rows of a sky per thread


class CpuBackend(Backend):
    """Kernels for float32 tensors on the CPU."""

    name = "cpu"
    has_static_layer = True

    def hardware(self) -> str:
        """See `Backend.hardware`."""
        from ..compilation import threads

        return f"CPU, {threads()} threads" if threads() > 1 else "CPU, 1 thread"

    def suits(self, like: Tensor) -> bool:
        """See `Backend.suits`."""
        return like.device.type == "cpu" and like.dtype == torch.float32

    def obstacle(self, like: Tensor) -> str | None:
        """See `Backend.obstacle`."""
        if importlib.util.find_spec("numba") is None:
            return "numba is not installed; remedy: pip install numba"
        if self.suits(like):
            return None
        return (
            f"expected float32 tensors on the CPU, got {like.dtype} on {like.device}; "
            "remedy: convert them, or use backend='reference'"
        )

    def rasterize_splats(
        self,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        channels: Tensor,
        camera: Camera,
        background: Tensor | None,
        labels: Tensor | None,
        settings: RasterSettings,
        stats: RasterStats | None,
    ) -> SplatImage:
        """See `Backend.rasterize_splats`."""
        from . import autograd

        return autograd.rasterize_splats(
            means, quats, scales, opacities, channels, camera, background, labels, settings, stats
        )

    def seen_colors(
        self, means: Tensor, sh: Tensor, rest: Tensor | None, factor: Tensor | None, poses: ViewPoses
    ) -> Tensor:
        """See `Backend.seen_colors`."""
        if not all(t is None or self.suits(t) for t in (sh, rest, factor)):
            return super().seen_colors(means, sh, rest, factor, poses)
        from . import autograd

        return autograd.seen_colors(means, sh, rest, factor, poses)

    def sky(self, sh: np.ndarray, camera: Camera) -> np.ndarray:
        """See `Backend.sky`."""
        from ..compilation import run
        from .sky import draw_sky

        rays = camera.T_cam_world[:3, :3].T @ np.linalg.inv(camera.intrinsics)
        image = np.empty((camera.height, camera.width, 3), np.float32)
        run(draw_sky, camera.height // _ROWS_WORTH_A_THREAD, np.ascontiguousarray(rays), sh, image)
        return image

    def segment_weights(
        self,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        camera: Camera,
        segments: Tensor,
        count: int,
        settings: RasterSettings,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `Backend.segment_weights`."""
        from . import autograd, forward

        shapes = [autograd.to_array(t) for t in (means, quats, scales, opacities)]
        known = torch.where((segments >= 0) & (segments < count), segments, -1).to(torch.int32).contiguous().numpy()
        return forward.segment_weights(shapes, camera, known, count, settings)

    def static_layer(self, *splats: Any, **options: Any) -> StaticLayer:
        """See `Backend.static_layer`."""
        from .static_layer import StaticLayer

        return StaticLayer(*splats, **options)
