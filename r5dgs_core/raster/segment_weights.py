"""What each Gaussian gives to each segment of an image: the blending weights, summed over the segment's pixels.

That sum is the derivative of the segment's blended sum with respect to the Gaussian's value, so one backward pass of
the rasterizer has it, for any number of Gaussians per pixel.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..scene.cameras import Camera
from .settings import RasterSettings
from .splatting import rasterize_splats

TOGETHER = 32  # segments in one pass, so that many take no more memory than some


def segment_weights(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    camera: Camera,
    segments: Tensor,  # [H, W]
    count: int,
    *,
    settings: RasterSettings | None = None,
    backend: str = "auto",
) -> Tensor:
    """Weight of each Gaussian in each segment of an image.

    Args:
        means: Centres, world. [N, 3]
        quats: Rotations wxyz. [N, 4]
        scales: Standard deviations, world units. [N, 3]
        opacities: In [0, 1]. [N]
        camera: The view.
        segments: Segment of each pixel, 0 to ``count`` - 1; pixels of others belong to none. [H, W] integers
        count: Number of segments S.
        settings: Of the rasterizer.
        backend: As of `rasterize_splats`.

    Returns:
        Sum over the segment's pixels of alpha times the transmittance before it; rows sum to what the image shows of
        the Gaussian, in pixels. [N, S]

    Raises:
        ValueError, BackendError: As `rasterize_splats`.
    """
    weights = means.new_zeros(len(means), count)
    fixed = (means.detach(), quats.detach(), scales.detach(), opacities.detach())
    for first in range(0, count, TOGETHER):
        some = torch.arange(first, min(first + TOGETHER, count), device=segments.device)
        members = (segments[..., None] == some).to(means)
        channels = means.new_zeros(len(means), len(some)).requires_grad_(True)
        with torch.enable_grad():
            image = rasterize_splats(*fixed, channels, camera, settings=settings, backend=backend).image
        (weights[:, first : first + len(some)],) = torch.autograd.grad(image, channels, members)
    return weights
