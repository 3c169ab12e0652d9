"""Blending weight of each Gaussian in each segment of an image, summed over the segment's pixels."""

from __future__ import annotations

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from ..raster import backends, rasterizer
from ..raster.settings import RasterSettings
from ..scene.cameras import Camera

TOGETHER = 32  # segments per backward pass; bounds the memory


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
) -> sparse.csr_matrix:  # [S, N]
    """Return the weights of the Gaussians in each segment of an image.

    Args:
        means: Centres, world. [N, 3]
        quats: Rotations wxyz. [N, 4]
        scales: Standard deviations, world units. [N, 3]
        opacities: In [0, 1]. [N]
        camera: The view.
        segments: Segment of each pixel, 0 to ``count`` - 1; other values belong to no segment. [H, W] integers
        count: Number of segments S.
        settings: Rasterizer settings.
        backend: As for `rasterizer.rasterize_splats`.

    Returns:
        Sparse sums of alpha times transmittance over the segment's pixels. A column sums to the Gaussian's visible
        area in the segments, in pixels. [S, N] float32

    Raises:
        ValueError, BackendError: As for `rasterizer.rasterize_splats`.
    """
    fixed = means.detach(), quats.detach(), scales.detach(), opacities.detach()
    if tuple(segments.shape) != (camera.height, camera.width):
        raise ValueError(
            f"segments: expected shape ({camera.height}, {camera.width}), the image's, got {tuple(segments.shape)}"
        )
    settings = settings or RasterSettings()
    rasterizer.check_splats(*fixed, fixed[0], camera, None, None)
    chosen = backends.choose_backend(backend, fixed[0])
    if chosen != "cpu":
        return _by_gradients(fixed, camera, segments, count, settings, chosen)
    from ..raster.cpu import cpu_backend

    known = torch.where((segments >= 0) & (segments < count), segments, -1).to(torch.int32).contiguous().numpy()
    rows, names, weights = cpu_backend.segment_weights(*fixed, camera, known, count, settings)
    by_gaussian = sparse.coo_matrix((weights, (rows, names)), (len(means), count)).tocsr()  # sums over the tiles
    return sparse.csr_matrix(by_gaussian.T)


def _by_gradients(
    fixed: tuple[Tensor, Tensor, Tensor, Tensor],
    camera: Camera,
    segments: Tensor,
    count: int,
    settings: RasterSettings,
    backend: str,
) -> sparse.csr_matrix:
    """Compute the weights by autograd: the derivative of a segment's blended sum by the Gaussian's value."""
    means, parts = fixed[0], []
    for first in range(0, count, TOGETHER):
        some = torch.arange(first, min(first + TOGETHER, count), device=segments.device)
        members = (segments[..., None] == some).to(means)
        channels = means.new_zeros(len(means), len(some)).requires_grad_(True)
        with torch.enable_grad():
            image = rasterizer.rasterize_splats(*fixed, channels, camera, settings=settings, backend=backend).image
        (weights,) = torch.autograd.grad(image, channels, members)
        parts.append(sparse.csr_matrix(weights.T.cpu().numpy().astype(np.float32)))
    return sparse.csr_matrix(sparse.vstack(parts) if parts else (0, len(means)), dtype=np.float32)
