"""Blending weight of each Gaussian in each segment of an image, summed over the segment's pixels."""

from __future__ import annotations

from scipy import sparse

from ..raster import backends, checks
from ..raster.arrays import Array
from ..raster.settings import RasterSettings
from ..scene.cameras import Camera


def segment_weights(
    means: Array,  # [N, 3]
    quats: Array,  # [N, 4]
    scales: Array,  # [N, 3]
    opacities: Array,  # [N]
    camera: Camera,
    segments: Array,  # [H, W]
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
    if tuple(segments.shape) != (camera.height, camera.width):
        raise ValueError(
            f"segments: expected shape ({camera.height}, {camera.width}), the image's, got {tuple(segments.shape)}"
        )
    splats = means, quats, scales, opacities
    checks.check_splats(*splats, means, camera, None, None)
    chosen = backends.choose(backend, means)
    rows, names, weights = chosen.segment_weights(*splats, camera, segments, count, settings or RasterSettings())
    by_gaussian = sparse.coo_matrix((weights, (rows, names)), (len(means), count)).tocsr()  # adds entries up
    return sparse.csr_matrix(by_gaussian.T)
