"""Backend `cpu`: float32 kernels on any number of threads, compiled by numba, which is imported on the first call."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np

from ...scene.cameras import Camera
from ..arrays import Array, device_of, is_float32, is_tensor, like, need_gradients, to_array
from ..backend import Backend, StaticLayer, ViewPoses
from ..settings import RasterSettings, RasterStats, SplatImage

_ROWS_WORTH_A_THREAD = 64  # rows of a sky per thread


class CpuBackend(Backend):
    """Kernels for float32 arrays, and tensors on the CPU."""

    name = "cpu"
    has_static_layer = True

    def hardware(self) -> str:
        """See `Backend.hardware`."""
        from ..thread_pool import threads

        return f"CPU, {threads()} threads" if threads() > 1 else "CPU, 1 thread"

    def suits(self, like: Array) -> bool:
        """See `Backend.suits`."""
        return device_of(like) == "cpu" and is_float32(like)

    def why_unavailable(self, like: Array) -> str | None:
        """See `Backend.why_unavailable`."""
        if importlib.util.find_spec("numba") is None:
            return "numba is not installed; remedy: pip install numba"
        if self.suits(like):
            return None
        return (
            f"expected float32 values on the CPU, got {like.dtype} on {device_of(like)}; "
            "remedy: convert them, or use backend='reference'"
        )

    def rasterize_splats(
        self,
        means: Array,
        quats: Array,
        scales: Array,
        opacities: Array,
        channels: Array,
        camera: Camera,
        background: Array | None,
        labels: Array | None,
        settings: RasterSettings,
        stats: RasterStats | None,
    ) -> SplatImage:
        """See `Backend.rasterize_splats`."""
        from . import forward

        inputs = (means, quats, scales, opacities, channels, background)
        plan = forward.CallArguments.of(camera, settings, to_array(labels))
        if need_gradients(*inputs):
            from . import autograd

            results = autograd.rasterize(inputs, plan, stats)
        else:
            arrays = [to_array(values) for values in inputs]
            _, *found, radii = forward.rasterize(arrays[:5], arrays[5], plan, False)
            results = [like(array, means) for array in found]
            if stats is not None:
                stats.fill(like(radii, means))
        image, alpha, depth, ids = results
        return SplatImage(image, alpha, depth, ids if labels is not None else None)

    def seen_colors(self, means: Array, sh: Array, rest: Array | None, factor: Array | None, poses: ViewPoses) -> Array:
        """See `Backend.seen_colors`."""
        if is_tensor(means) and not all(values is None or self.suits(values) for values in (sh, rest, factor)):
            from .. import torch_backend

            return torch_backend.seen_colors(means, sh, rest, factor, poses)
        if need_gradients(means, sh, rest, factor):
            from . import autograd

            return autograd.seen_colors(means, sh, rest, factor, poses)
        from . import forward

        sh, rest, factor = (None if given is None else like(given, means, means.dtype) for given in (sh, rest, factor))
        colors = forward.seen_colors(to_array(means), to_array(sh), to_array(rest), to_array(factor), poses)
        return like(colors, means)

    def sky(self, sh: np.ndarray, camera: Camera) -> np.ndarray:
        """See `Backend.sky`."""
        from ..thread_pool import run
        from .sky import draw_sky

        rays = camera.T_cam_world[:3, :3].T @ np.linalg.inv(camera.intrinsics)
        image = np.empty((camera.height, camera.width, 3), np.float32)
        run(draw_sky, camera.height // _ROWS_WORTH_A_THREAD, np.ascontiguousarray(rays), sh, image)
        return image

    def segment_weights(
        self,
        means: Array,
        quats: Array,
        scales: Array,
        opacities: Array,
        camera: Camera,
        segments: Array,
        count: int,
        settings: RasterSettings,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `Backend.segment_weights`."""
        from . import forward

        shapes = [to_array(values) for values in (means, quats, scales, opacities)]
        numbers = to_array(segments)
        known = np.full(numbers.shape, -1, np.int32)
        np.copyto(known, numbers, casting="unsafe", where=(numbers >= 0) & (numbers < count))
        return forward.segment_weights(shapes, camera, known, count, settings)

    def static_layer(self, *splats: Any, **options: Any) -> StaticLayer:
        """See `Backend.static_layer`."""
        from .static_layer import StaticLayer

        return StaticLayer(*splats, **options)


BACKEND = CpuBackend()
