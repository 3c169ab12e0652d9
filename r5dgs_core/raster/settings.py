"""What goes into the rasterizer beside the Gaussians, and what comes out of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch

BACKENDS = ("auto", "cpu", "cuda", "reference")


@dataclass(frozen=True)
class RasterSettings:
    """Thresholds of 3D Gaussian splatting; the defaults are those of 3DGS.

    Attributes:
        near_plane: Gaussians whose centre lies nearer than this depth are not drawn, world units.
        dilation: Added to both variances of the projected Gaussian, px^2 (a low-pass of about half a pixel); 0.01 or
            more: rounding of a needle's exponent grows as its width shrinks, and the margin within which the kernels
            decide in float64 is made for no thinner ones.
        frustum_slack: The slope of a centre seen from the camera is clamped to the image border plus this share of the
            half field of view before the projection is linearised there: 1.3 times the field of view for 0.3.
        alpha_min: Contributions below this are dropped.
        alpha_max: Contributions are capped here; the gradient is zero where the cap holds.
        transmittance_min: A pixel is finished before the contribution that would bring its transmittance down to this,
            two layers at the default cap for example; see `finished_at`. 1e-30 or more, as pixels are float32.
        id_alpha_min: Pixels with less alpha than this belong to no object (id -1). In [0, 1].
    """

    near_plane: float = 0.01
    dilation: float = 0.3
    frustum_slack: float = 0.3
    alpha_min: float = 1.0 / 255.0
    alpha_max: float = 0.99
    transmittance_min: float = 1e-4
    id_alpha_min: float = 0.5

    @property
    def finished_at(self) -> float:
        """What transmittance must not fall below: ``transmittance_min`` with a margin for rounding.

        Two capped layers leave (1 - 0.99)^2 = 1e-4 of the light, a rounding below it in float32 and a rounding above in
        float64; 3DGS and gsplat compute in float32 and stop there, so everyone has to.
        """
        return self.transmittance_min * (1 + 1e-6)

    def __post_init__(self):
        for field in fields(self):
            if not math.isfinite(getattr(self, field.name)):
                raise ValueError(
                    f"raster settings: {field.name}: expected a finite number, got {getattr(self, field.name)}"
                )
        bounds = {
            "near_plane": (self.near_plane > 0, "more than 0"),
            "dilation": (self.dilation >= 0.01, "0.01 or more"),
            "frustum_slack": (self.frustum_slack >= 0, "0 or more"),
            "alpha_min": (1e-4 <= self.alpha_min < self.alpha_max, "1e-4 or more, and less than alpha_max"),
            "alpha_max": (self.alpha_max <= 0.999, "at most 0.999"),
            "transmittance_min": (1e-30 <= self.transmittance_min < 1, "1e-30 or more, and less than 1"),
            "id_alpha_min": (0 <= self.id_alpha_min <= 1, "0 to 1"),
        }
        for name, (fits, expected) in bounds.items():
            if not fits:
                raise ValueError(f"raster settings: {name}: expected {expected}, got {getattr(self, name)}")


@dataclass
class RasterStats:
    """What densification wants to know of one call; pass an empty one and read it afterwards.

    Attributes:
        visible: Whether the Gaussian touches the image, known after the call. [N] bool
        radii: Three standard deviations along the long axis of the projected Gaussian, px, 0 where not visible. [N]
        grad_norm: Norm of the gradient with respect to the projected centre, per px of this view, known after the
            backward pass, 0 where not visible. [N]
    """

    visible: torch.Tensor | None = None
    radii: torch.Tensor | None = None
    grad_norm: torch.Tensor | None = None


@dataclass(frozen=True)
class SplatImage:
    """An image of splats with any number of channels.

    Attributes:
        image: Blended channels over the background. [H, W, D]
        alpha: Coverage. [H, W]
        depth: Expected depth z in the camera frame, divided by alpha; 0 where alpha is 0. [H, W]
        ids: Label with the largest weight, -1 where there is none; only where labels were given. [H, W] int32
    """

    image: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor
    ids: torch.Tensor | None = None


@dataclass(frozen=True)
class RenderOutput:
    """What a camera sees of the Gaussians.

    Attributes:
        color: Display-referred colour over the background. [H, W, 3]
        alpha: Coverage. [H, W]
        depth: Expected depth z in the camera frame, divided by alpha; 0 where alpha is 0. [H, W]
        features: Blended features over zeros, or None where none were given. [H, W, F]
        ids: Object with the largest weight, -1 where there is none, or None without object ids. [H, W] int32
        holdout: Coverage of hold-outs, which alpha and depth leave out, or None without any. [H, W]
    """

    color: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor
    features: torch.Tensor | None = None
    ids: torch.Tensor | None = None
    holdout: torch.Tensor | None = None
