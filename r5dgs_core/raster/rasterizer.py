"""Public API of the rasterizer: validates inputs, selects a backend and evaluates spherical harmonics."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..scene.cameras import Camera
from ..scene.splats import to_opacities
from . import backends, checks, shade
from .arrays import Array, array_namespace, like, takes_kernels
from .settings import RasterSettings, RasterStats, RenderOutput, SplatImage


def rasterize_splats(
    means: Array,  # [N, 3]
    quats: Array,  # [N, 4]
    scales: Array,  # [N, 3]
    opacities: Array,  # [N]
    channels: Array,  # [N, D]
    camera: Camera,
    background: Array | None = None,  # [D] or [H, W, D]
    *,
    labels: Array | None = None,  # [N]
    settings: RasterSettings | None = None,
    backend: str = "auto",
    stats: RasterStats | None = None,
) -> SplatImage:
    """Rasterize Gaussians with any number of channels.

    Inputs are numpy arrays, or torch tensors with gradients for every float input except the camera.

    Args:
        means: Centres, world. [N, 3]
        quats: Rotations wxyz; normalised here, with gradients through the normalisation. [N, 4]
        scales: Standard deviations along the Gaussian's axes, world units, >= 0. [N, 3]
        opacities: In [0, 1]. [N]
        channels: Values to blend; D >= 1. [N, D]
        camera: The view.
        background: Blended with weight 1 - alpha; zeros if None. Any float dtype. [D] or [H, W, D]
        labels: Integers; ``ids`` of the result is the label with the largest weight; negative labels count as -1. At
            most 2^31 - 1, or 2^24 - 1 with backend "cpu". [N]
        settings: Thresholds; those of 3DGS if None.
        backend: "cpu" (numba, float32), "cuda" (gsplat, float32 tensors on a GPU), "reference" (plain torch, any float
            dtype and device), or "auto": the fastest that supports these inputs.
        stats: Receives visibility and radii from this call, and screen-space gradients from the backward pass.

    Returns:
        Image, alpha and depth: arrays or tensors, as the inputs are, with device and dtype of ``means``.

    Raises:
        TypeError: An input is neither an array nor a tensor, or arrays and tensors are mixed.
        ValueError: An input has a wrong shape, dtype or device, or an input or the camera has a value that is not
            finite or out of range; the message names the input and the first index.
        BackendError: The backend is not available.

    Source: Kerbl et al. 2023 (3DGS), sections 4 and 6, after Zwicker et al. 2001 (EWA splatting).
    """
    settings = settings or RasterSettings()
    if not isinstance(settings, RasterSettings):
        raise TypeError(f"settings: expected RasterSettings, got {type(settings).__name__}")
    inputs = means, quats, scales, opacities, channels
    checks.check_splats(*inputs, camera, background, labels, values=settings.exact or takes_kernels(means))
    chosen = backends.choose(backend, means)
    if background is not None:
        background = like(background, means, means.dtype)
    return chosen.rasterize_splats(
        means, quats, scales, opacities, channels, camera, background, labels, settings, stats
    )


def rasterize(
    gaussians: Any,
    camera: Camera,
    features: Array | None = None,  # [N, F]
    background: Array | None = None,  # [3] or [H, W, 3]
    *,
    colors: Array | None = None,  # [N, 3]
    ids: bool = True,
    settings: RasterSettings | None = None,
    backend: str = "auto",
    stats: RasterStats | None = None,
) -> RenderOutput:
    """Rasterize the colours of Gaussians for a camera, and features in the same pass.

    Args:
        gaussians: Object with ``means``, ``quats``, ``log_scales``, ``opacity_logits``, ``sh`` [N, K, 3] and,
            optionally, ``object_ids`` [N]. ``scales`` and ``opacities`` may replace logarithms and logits.
        camera: The view.
        features: Further values to blend, e.g. identity encodings. [N, F]
        background: Colour behind the Gaussians; black if None. Any float dtype. [3] or [H, W, 3]
        colors: Final colours, which replace those of `seen_colors`; ``sh`` is then not read. [N, 3]
        ids: True to compute the object of each pixel, if ``object_ids`` exist.
        settings: As for `rasterize_splats`, like ``backend`` and ``stats``.

    Returns:
        Colour, alpha, depth, features and ids.

    Raises:
        TypeError, ValueError, BackendError: As for `rasterize_splats`; messages name the inputs of this function.
    """
    means = gaussians.means
    checks.check_appearance(means, camera, colors, features, background)
    object_ids = getattr(gaussians, "object_ids", None) if ids else None
    try:
        channels = seen_colors(gaussians, camera, backend=backend) if colors is None else colors
        if features is not None and features.shape[1]:
            channels, background = _appended(channels, features, background)
        splats = rasterize_splats(
            means,
            gaussians.quats,
            *_shapes(gaussians),
            like(channels, means, means.dtype),
            camera,
            background,
            labels=None if object_ids is None else like(object_ids, means),
            settings=settings,
            backend=backend,
            stats=stats,
        )
    except ValueError:
        checks.check_raw(gaussians, colors, features)
        raise
    return RenderOutput(
        color=splats.image[..., :3],
        alpha=splats.alpha,
        depth=splats.depth,
        features=splats.image[..., 3:] if features is not None else None,
        ids=splats.ids,
    )


def _appended(colors: Array, features: Array, background: Array | None) -> tuple[Array, Array | None]:
    """Append features to colours, and zeros to the background."""
    xp = array_namespace(colors)
    channels = xp.concatenate([colors, like(features, colors, colors.dtype)], 1)
    if background is not None:
        zeros = np.zeros((*background.shape[:-1], features.shape[1]))
        background = xp.concatenate([background, like(zeros, background, background.dtype)], -1)
    return channels, background


def _shapes(gaussians: Any) -> tuple[Array, Array]:
    """Scales and opacities of Gaussians that store them or their raw parameters."""
    xp = array_namespace(gaussians.means)
    scales = gaussians.scales if hasattr(gaussians, "scales") else xp.exp(gaussians.log_scales)
    if hasattr(gaussians, "opacities"):
        return scales, gaussians.opacities
    logits = gaussians.opacity_logits
    return scales, to_opacities(logits).astype(logits.dtype) if xp is np else xp.sigmoid(logits)


def seen_colors(gaussians: Any, camera: Camera, *, backend: str = "auto") -> Array:
    """Return the display-referred colour of each Gaussian for a camera: max(0, 0.5 + harmonics). [N, 3]

    Args:
        gaussians: Object with ``means`` [N, 3] and ``sh`` [N, K, 3].
        camera: The view.
        backend: As for `rasterize_splats`.
    """
    return shade.seen_colors(gaussians.means, gaussians.sh, camera.center, backend=backend)
