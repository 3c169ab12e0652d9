"""Base class of the backends that compute in torch, with slow defaults for everything but the image."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..scene import spherical_harmonics
from ..scene.cameras import Camera
from .arrays import Array, to_array
from .backend import Backend, ViewPoses
from .settings import RasterSettings, RasterStats, SplatImage

SEGMENTS_PER_PASS = 32  # segments per backward pass of `TorchBackend.segment_weights`; bounds the memory


class TorchBackend(Backend):
    """Backend whose methods take and return tensors. Subclasses implement `rasterize_splats` at least."""

    def for_inputs(self, like: Array) -> Backend:
        """See `Backend.for_inputs`."""
        return ArrayAdapter(self) if isinstance(like, np.ndarray) else self

    def seen_colors(
        self, means: Tensor, sh: Tensor, rest: Tensor | None, factor: Tensor | None, poses: ViewPoses
    ) -> Tensor:
        """See `Backend.seen_colors`."""
        return seen_colors(means, sh, rest, factor, poses)

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
        """Implement `Backend.segment_weights` by the gradient of each segment's blended sum by the Gaussian's value."""
        parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float32))]
        for first in range(0, count, SEGMENTS_PER_PASS):
            some = torch.arange(first, min(first + SEGMENTS_PER_PASS, count), device=segments.device)
            members = (segments[..., None] == some).to(means)
            channels = means.new_zeros(len(means), len(some)).requires_grad_(True)
            with torch.enable_grad():
                image = self.rasterize_splats(
                    means, quats, scales, opacities, channels, camera, None, None, settings, None
                ).image
            (gradient,) = torch.autograd.grad(image, channels, members)
            weights = gradient.cpu().numpy().astype(np.float32)
            rows, names = np.nonzero(weights)
            parts.append((rows, first + names, weights[rows, names]))
        rows, names, weights = (np.concatenate(column) for column in zip(*parts, strict=True))
        return rows, names, weights


def seen_colors(means: Tensor, sh: Tensor, rest: Tensor | None, factor: Tensor | None, poses: ViewPoses) -> Tensor:
    """Implement `Backend.seen_colors` for tensors of any dtype and device, differentiable."""
    sh = sh if rest is None else torch.cat([sh, rest], 1)
    ids = torch.as_tensor(poses.ids).to(means.device, non_blocking=True) if len(poses.ids) else slice(0, 1)
    maps, eyes = (torch.as_tensor(a).to(means, non_blocking=True) for a in (poses.maps, poses.eyes))
    offsets = (maps[ids] @ (means - eyes[ids])[..., None])[..., 0]
    square = (offsets * offsets).sum(-1, keepdim=True)
    at_the_eye = square <= 0
    lengths = torch.sqrt(torch.where(at_the_eye, torch.ones_like(square), square))
    directions = torch.where(at_the_eye, torch.zeros_like(offsets), offsets / lengths)
    colors = spherical_harmonics.to_rgb(sh, directions).clamp_min(0)
    return colors if factor is None else colors * factor[:, None]


class ArrayAdapter(Backend):
    """Backend of tensors that takes and returns arrays, without gradients.

    Args:
        inner: The backend.
        device: Device of its tensors. "auto" never selects one that is not the CPU for arrays.
    """

    def __init__(self, inner: TorchBackend, device: str = "cpu"):
        self.name = inner.name  # type: ignore[misc]
        self._inner = inner
        self._device = device

    def hardware(self) -> str:
        return self._inner.hardware()

    def suits(self, like: Array) -> bool:
        return self._device == "cpu" and self._inner.suits(self._tensor(like))

    def why_unavailable(self, like: Array) -> str | None:
        kind = torch.from_numpy(to_array(like[:0])).dtype
        return self._inner.why_unavailable(SimpleNamespace(device=torch.device(self._device), dtype=kind))

    @torch.no_grad()
    def rasterize_splats(
        self, means, quats, scales, opacities, channels, camera, background, labels, settings, stats
    ) -> SplatImage:
        inputs = means, quats, scales, opacities, channels, background, labels
        means, quats, scales, opacities, channels, background, labels = map(self._tensor, inputs)
        found = self._inner.rasterize_splats(
            means, quats, scales, opacities, channels, camera, background, labels, settings, stats
        )
        _stats_to_arrays(stats)
        return SplatImage(*(_array(values) for values in (found.image, found.alpha, found.depth, found.ids)))

    @torch.no_grad()
    def seen_colors(self, means, sh, rest, factor, poses):
        means, sh, rest, factor = map(self._tensor, (means, sh, rest, factor))
        return _array(self._inner.seen_colors(means, sh, rest, factor, poses))

    def segment_weights(self, means, quats, scales, opacities, camera, segments, count, settings):
        means, quats, scales, opacities, segments = map(self._tensor, (means, quats, scales, opacities, segments))
        return self._inner.segment_weights(means, quats, scales, opacities, camera, segments, count, settings)

    def _tensor(self, values: np.ndarray | None) -> Any:
        return None if values is None else torch.from_numpy(to_array(values)).to(self._device)


def _array(values: Tensor | None) -> np.ndarray | None:
    return None if values is None else to_array(values.cpu())


def _stats_to_arrays(stats: RasterStats | None) -> None:
    """Turn the tensors of statistics into arrays."""
    if stats is not None:
        stats.visible, stats.radii, stats.grad_norm = map(_array, (stats.visible, stats.radii, stats.grad_norm))
