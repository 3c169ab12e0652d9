"""Public API of the rasterizer: validates inputs, selects a backend and evaluates spherical harmonics."""

from __future__ import annotations

from typing import Any

import torch

from ..scene.cameras import Camera
from . import backends, checks, shade
from .settings import RasterSettings, RasterStats, RenderOutput, SplatImage


def rasterize_splats(
    means: torch.Tensor,  # [N, 3]
    quats: torch.Tensor,  # [N, 4]
    scales: torch.Tensor,  # [N, 3]
    opacities: torch.Tensor,  # [N]
    channels: torch.Tensor,  # [N, D]
    camera: Camera,
    background: torch.Tensor | None = None,  # [D] or [H, W, D]
    *,
    labels: torch.Tensor | None = None,  # [N]
    settings: RasterSettings | None = None,
    backend: str = "auto",
    stats: RasterStats | None = None,
) -> SplatImage:
    """Rasterize Gaussians with any number of channels, differentiable in every float input except the camera.

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
            dtype and device), or "auto": the fastest that supports these tensors.
        stats: Receives visibility and radii from this call, and screen-space gradients from the backward pass.

    Returns:
        Image, alpha and depth, with device and dtype of ``means``.

    Raises:
        TypeError: An input is not a tensor.
        ValueError: An input has a wrong shape, dtype or device, or an input or the camera has a value that is not
            finite or out of range; the message names the input and the first index.
        BackendError: The backend is not available.

    Source: Kerbl et al. 2023 (3DGS), sections 4 and 6, after Zwicker et al. 2001 (EWA splatting).
    """
    settings = settings or RasterSettings()
    if not isinstance(settings, RasterSettings):
        raise TypeError(f"settings: expected RasterSettings, got {type(settings).__name__}")
    checks.check_splats(means, quats, scales, opacities, channels, camera, background, labels)
    chosen = backends.choose(backend, means)
    if background is not None:
        background = background.to(means.dtype)
    return chosen.rasterize_splats(
        means, quats, scales, opacities, channels, camera, background, labels, settings, stats
    )


def rasterize(
    gaussians: Any,
    camera: Camera,
    features: torch.Tensor | None = None,  # [N, F]
    background: torch.Tensor | None = None,  # [3] or [H, W, 3]
    *,
    colors: torch.Tensor | None = None,  # [N, 3]
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
            channels = torch.cat([channels.to(means.dtype), features.to(means.dtype)], 1)
            if background is not None:
                zeros = background.new_zeros((*background.shape[:-1], features.shape[1]))
                background = torch.cat([background, zeros], -1)
        splats = rasterize_splats(
            means,
            gaussians.quats,
            gaussians.scales if hasattr(gaussians, "scales") else torch.exp(gaussians.log_scales),
            gaussians.opacities if hasattr(gaussians, "opacities") else torch.sigmoid(gaussians.opacity_logits),
            channels.to(means.dtype),
            camera,
            background,
            labels=None if object_ids is None else torch.as_tensor(object_ids, device=means.device),
            settings=settings,
            backend=backend,
            stats=stats,
        )
    except ValueError as error:
        raise (_raw_culprit(gaussians, colors, features) or error) from None
    return RenderOutput(
        color=splats.image[..., :3],
        alpha=splats.alpha,
        depth=splats.depth,
        features=splats.image[..., 3:] if features is not None else None,
        ids=splats.ids,
    )


def seen_colors(gaussians: Any, camera: Camera, *, backend: str = "auto") -> torch.Tensor:
    """Return the display-referred colour of each Gaussian for a camera: max(0, 0.5 + harmonics). [N, 3]

    Args:
        gaussians: Object with ``means`` [N, 3] and ``sh`` [N, K, 3].
        camera: The view.
        backend: As for `rasterize_splats`.
    """
    return shade.seen_colors(gaussians.means, gaussians.sh, camera.center, backend=backend)


def _raw_culprit(gaussians: Any, colors: Any, features: Any) -> ValueError | None:
    """Find the invalid input of `rasterize` after a failure: an error that uses the caller's names, or None."""
    n = len(gaussians.means)
    given: dict[str, Any] = {
        name: getattr(gaussians, name, None) for name in ("means", "quats", "log_scales", "opacity_logits", "sh")
    }
    derived = {"log_scales": ("scales", (n, 3)), "opacity_logits": ("opacities", (n,))}
    for name, (result, shape) in derived.items():
        if hasattr(gaussians, result):
            del given[name]
        elif given[name] is not None and tuple(given[name].shape) != shape:
            return ValueError(f"{name}: expected shape {shape}, got {tuple(given[name].shape)}")
    if colors is not None:
        given["sh"] = None
    for name, values in {**given, "colors": colors, "features": features}.items():
        if not isinstance(values, torch.Tensor):
            continue
        values = values.detach()
        if name == "log_scales":
            bad, wanted = ~torch.isfinite(torch.exp(values)), "values with a finite exponential"
        elif name == "opacity_logits":
            bad, wanted = torch.isnan(values), "numbers"
        else:
            bad, wanted = ~torch.isfinite(values), "finite values"
        if bad.any():
            at = tuple(torch.nonzero(bad)[0].tolist())
            return ValueError(f"{name}: expected {wanted}, found {values[at].item()} at index {at}")
    return None
