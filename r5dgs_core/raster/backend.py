"""Base class of the rasterizer backends: one class per backend, with slow defaults for everything but the image.

All inputs are checked by the public functions of this room before a backend sees them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from ..scene import cameras, sh_color
from ..scene.cameras import Camera
from .settings import RasterSettings, RasterStats, SplatImage

TOGETHER = 32  # segments per backward pass of `Backend.segment_weights`; bounds the memory


class StaticLayer(Protocol):
    """Static Gaussians of a fixed camera; see `cpu.static_layer.StaticLayer`."""

    def draw(
        self,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        channels: Tensor,
        labels: Tensor | None = None,
        ranks: np.ndarray | None = None,
    ) -> SplatImage:
        """Draw moving Gaussians into the static layer, without gradients."""
        ...


@dataclass(frozen=True)
class ViewPoses:
    """Eyes of view-dependent colours, in the frames of the coefficients.

    Attributes:
        eyes: Eye of each pose in the frame of the means. [P, 3] float64
        maps: Map of each pose from directions to the frame of the coefficients. [P, 3, 3] float64
        ids: Pose of each Gaussian; empty if all have the first. [N] or [0] int64
    """

    eyes: np.ndarray
    maps: np.ndarray
    ids: np.ndarray


class Backend:
    """Rasterizer for tensors of certain devices and dtypes.

    Attributes:
        name: Name in options, configurations and messages.
        has_static_layer: True if `static_layer` is implemented.
    """

    name: ClassVar[str]
    has_static_layer: ClassVar[bool] = False

    def hardware(self) -> str:
        """Return a description of the hardware that the backend uses, for reports."""
        return "CPU without kernels"

    def suits(self, like: Tensor) -> bool:
        """Return True if the backend is made for the device and dtype of a tensor. "auto" tries no others."""
        return True

    def obstacle(self, like: Tensor) -> str | None:
        """Return why tensors like this one cannot be rasterized here, and the remedy; None if they can."""
        return None

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
        """Implement `rasterizer.rasterize_splats`."""
        raise NotImplementedError

    def seen_colors(
        self, means: Tensor, sh: Tensor, rest: Tensor | None, factor: Tensor | None, poses: ViewPoses
    ) -> Tensor:
        """Implement `shade.seen_colors` for degree 1 and higher. [N, 3]"""
        sh = sh if rest is None else torch.cat([sh, rest], 1)
        ids = torch.as_tensor(poses.ids, device=means.device) if len(poses.ids) else slice(0, 1)
        maps, eyes = (torch.as_tensor(a, dtype=means.dtype, device=means.device) for a in (poses.maps, poses.eyes))
        offsets = (maps[ids] @ (means - eyes[ids])[..., None])[..., 0]
        square = (offsets * offsets).sum(-1, keepdim=True)
        at_the_eye = square <= 0
        lengths = torch.sqrt(torch.where(at_the_eye, torch.ones_like(square), square))
        directions = torch.where(at_the_eye, torch.zeros_like(offsets), offsets / lengths)
        colors = sh_color.to_rgb(sh, directions).clamp_min(0)
        return colors if factor is None else colors * factor[:, None]

    def sky(self, sh: np.ndarray, camera: Camera) -> np.ndarray:
        """Implement `shade.sky` for degree 1 and higher, float64 coefficients. [H, W, 3] float32"""
        return np.clip(sh_color.to_rgb(sh, cameras.pixel_rays(camera)), 0, 1).astype(np.float32)

    def segment_weights(
        self,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        camera: Camera,
        segments: Tensor,  # [H, W]
        count: int,
        settings: RasterSettings,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return weights of Gaussians in segments of an image as entries: Gaussians, segments, weights. [E] each

        Entries of the same Gaussian and segment add up. See `render.segment_weights`. The default is the derivative of
        each segment's blended sum by the Gaussian's value.
        """
        parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float32))]
        for first in range(0, count, TOGETHER):
            some = torch.arange(first, min(first + TOGETHER, count), device=segments.device)
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

    def static_layer(self, *splats: Any, **options: Any) -> StaticLayer:
        """Rasterize static Gaussians once; arguments as for `cpu.static_layer.StaticLayer`."""
        raise NotImplementedError
