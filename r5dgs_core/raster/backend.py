"""Base class of the rasterizer backends: one class per backend.

All inputs are checked by the public functions of this room before a backend sees them. They are numpy arrays or torch
tensors, and results are of the same kind. `torch_backend.TorchBackend` is the base of backends that compute in torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np

from ..scene import cameras, spherical_harmonics
from ..scene.cameras import Camera
from .arrays import Array
from .settings import RasterSettings, RasterStats, SplatImage


class StaticLayer(Protocol):
    """Static Gaussians of a fixed camera; see `cpu.static_layer.StaticLayer`."""

    def draw(
        self,
        means: Array,
        quats: Array,
        scales: Array,
        opacities: Array,
        channels: Array,
        labels: Array | None = None,
        ranks: np.ndarray | None = None,
    ) -> SplatImage:
        """Draw moving Gaussians into the static layer, without gradients."""
        ...


@dataclass(frozen=True)
class ViewPoses:
    """Eyes of view-dependent colours, in the frames of the coefficients.

    Attributes:
        eyes: Eye of each pose in the frame of the means. [P, 3] float64, or a tensor on a GPU
        maps: Map of each pose from directions to the frame of the coefficients. [P, 3, 3] float64, or such a tensor
        ids: Pose of each Gaussian; empty if all have the first. [N] or [0] int64, or such a tensor
    """

    eyes: Array
    maps: Array
    ids: Array


class Backend:
    """Rasterizer for arrays or tensors of certain devices and dtypes.

    Attributes:
        name: Name in options, configurations and messages.
        has_static_layer: True if `static_layer` is implemented.
    """

    name: ClassVar[str]
    has_static_layer: ClassVar[bool] = False

    def for_inputs(self, like: Array) -> Backend:
        """Return the backend that takes inputs of this kind, array or tensor."""
        return self

    def hardware(self) -> str:
        """Return a description of the hardware that the backend uses, for reports."""
        return "CPU without kernels"

    def suits(self, like: Array) -> bool:
        """Return True if the backend is made for the device and dtype of an input. "auto" skips all others."""
        return True

    def why_unavailable(self, like: Array) -> str | None:
        """Return the reason why inputs like this one cannot be rasterized here, and the remedy; None if they can."""
        return None

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
        """Implement `rasterizer.rasterize_splats`."""
        raise NotImplementedError

    def seen_colors(self, means: Array, sh: Array, rest: Array | None, factor: Array | None, poses: ViewPoses) -> Array:
        """Implement `shade.seen_colors` for degree 1 and higher. [N, 3]"""
        raise NotImplementedError

    def sky(self, sh: np.ndarray, camera: Camera) -> np.ndarray:
        """Implement `shade.sky` for degree 1 and higher, float64 coefficients. [H, W, 3] float32"""
        return np.clip(spherical_harmonics.to_rgb(sh, cameras.pixel_rays(camera)), 0, 1).astype(np.float32)

    def segment_weights(
        self,
        means: Array,
        quats: Array,
        scales: Array,
        opacities: Array,
        camera: Camera,
        segments: Array,  # [H, W]
        count: int,
        settings: RasterSettings,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return weights of Gaussians in segments of an image as entries: Gaussians, segments, weights. [E] each

        Entries of the same Gaussian and segment add up. See `render.segment_weights`.
        """
        raise NotImplementedError

    def static_layer(self, *splats: Any, **options: Any) -> StaticLayer:
        """Rasterize static Gaussians once; arguments as for `cpu.static_layer.StaticLayer`."""
        raise NotImplementedError
