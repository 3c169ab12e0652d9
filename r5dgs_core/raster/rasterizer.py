"""Public API of the rasterizer: validates inputs, selects a backend and evaluates spherical harmonics."""

from __future__ import annotations

import math
from typing import Any

import torch

from ..scene import cameras
from ..scene.cameras import Camera
from . import backends, cuda, reference, shade
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
    check_splats(means, quats, scales, opacities, channels, camera, background, labels)
    chosen = backends.choose_backend(backend, means)
    if background is not None:
        background = background.to(means.dtype)
    if chosen == "cpu":
        from .cpu import cpu_backend as implementation
    else:
        implementation = reference if chosen == "reference" else cuda
    return implementation.rasterize_splats(
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
    _check_tensor("means", means)
    cameras.check(camera)
    if colors is not None:
        _check_companion("colors", colors, means, (len(means), 3))
    if features is not None:
        _check_companion("features", features, means, (len(means), "F"))
    if background is not None:
        _check_background(background, means, camera, 3)
    object_ids = getattr(gaussians, "object_ids", None) if ids else None
    try:
        channels = seen_colors(gaussians, camera, fused=backend in ("auto", "cpu")) if colors is None else colors
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


def seen_colors(gaussians: Any, camera: Camera, *, fused: bool = True) -> torch.Tensor:
    """Return the display-referred colour of each Gaussian for a camera: max(0, 0.5 + harmonics). [N, 3]

    Args:
        gaussians: Object with ``means`` [N, 3] and ``sh`` [N, K, 3].
        camera: The view.
        fused: True to allow the kernels of the `cpu` backend.
    """
    return shade.seen_colors(gaussians.means, gaussians.sh, camera.center, fused=fused)


def check_splats(means, quats, scales, opacities, channels, camera, background, labels) -> None:
    """Raise ValueError or TypeError for the first input with an invalid type, shape, dtype, device or value."""
    inputs = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "channels": channels}
    for name, tensor in inputs.items():
        _check_tensor(name, tensor)
        if not tensor.is_floating_point():
            raise ValueError(f"{name}: expected floating-point values, got {tensor.dtype}; remedy: {name}.float()")
    n = len(means) if means.ndim else 0
    shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
    for name, tensor in inputs.items():
        expected = shapes.get(name, (n, channels.shape[-1] if channels.ndim == 2 and channels.shape[-1] else "D >= 1"))
        if tuple(tensor.shape) != expected:
            wanted = str(expected).replace("'", "")
            raise ValueError(f"{name}: expected shape {wanted}, got {tuple(tensor.shape)}")
        if tensor.dtype != means.dtype or tensor.device != means.device:
            raise ValueError(
                f"{name}: expected {means.dtype} on {means.device}, as the means are, got {tensor.dtype} on "
                f"{tensor.device}; remedy: {name}.to(means), or convert the means"
            )
    cameras.check(camera)
    if background is not None:
        _check_background(background, means, camera, channels.shape[-1])
        inputs["background"] = background.to(means.dtype)
    if labels is not None:
        _check_labels(labels, means)
    for name, tensor in inputs.items():
        _check_values(name, tensor.detach(), *_RANGES.get(name, (-math.inf, math.inf, "")))


# Bounds of inputs with a limited range, and the remedy.
_RANGES: dict[str, tuple[float, float, str]] = {
    "scales": (0.0, math.inf, "pass exp(log_scales)"),
    "opacities": (0.0, 1.0, "pass sigmoid(opacity_logits)"),
}


def _check_tensor(name: str, value: Any) -> None:
    if not isinstance(value, torch.Tensor):
        raise TypeError(f"{name}: expected a tensor, got {type(value).__name__}; remedy: torch.as_tensor({name})")


def _check_device(name: str, tensor: torch.Tensor, means: torch.Tensor) -> None:
    if tensor.device != means.device:
        raise ValueError(f"{name}: expected a tensor on {means.device}, as the means are, got one on {tensor.device}")


def _check_companion(name: str, tensor: Any, means: torch.Tensor, shape: tuple[int, int | str]) -> None:
    """Raise unless the value is a tensor on the device of the means with the given shape; a str matches any size."""
    _check_tensor(name, tensor)
    if tensor.ndim != 2 or any(isinstance(b, int) and a != b for a, b in zip(tensor.shape, shape, strict=True)):
        raise ValueError(f"{name}: expected shape ({shape[0]}, {shape[1]}), got {tuple(tensor.shape)}")
    _check_device(name, tensor, means)


def _check_background(background: Any, means: torch.Tensor, camera: Camera, depth: int) -> None:
    """Raise unless the value is a background for an image with ``depth`` channels."""
    _check_tensor("background", background)
    if tuple(background.shape) not in {(depth,), (camera.height, camera.width, depth)}:
        raise ValueError(
            f"background: expected shape ({depth},) or ({camera.height}, {camera.width}, {depth}), "
            f"got {tuple(background.shape)}"
        )
    if not background.is_floating_point():
        raise ValueError(
            f"background: expected floating-point values, got {background.dtype}; remedy: background.float(), "
            "divided by 255 for 8-bit colours"
        )
    _check_device("background", background, means)


_MOST_LABEL = (1 << 31) - 1  # ids are int32
_NARROW = (torch.uint8, torch.int8, torch.int16, torch.int32)  # dtypes that cannot exceed _MOST_LABEL


def _check_labels(labels: Any, means: torch.Tensor) -> None:
    """Raise unless the labels are integers in range, one per Gaussian."""
    _check_tensor("labels", labels)
    whole = not (labels.is_floating_point() or labels.is_complex() or labels.dtype == torch.bool)
    if tuple(labels.shape) != (len(means),) or not whole:
        raise ValueError(f"labels: expected {len(means)} integers, got {labels.dtype} of shape {tuple(labels.shape)}")
    _check_device("labels", labels, means)
    if labels.dtype in _NARROW or not len(labels):
        return
    numbers = labels.long()
    if labels.dtype == torch.uint64:  # values from 2^63 on have become negative
        numbers = torch.where(numbers < 0, torch.iinfo(torch.int64).max, numbers)
    if numbers.max() > _MOST_LABEL:
        at = int(numbers.argmax())
        raise ValueError(f"labels: expected at most {_MOST_LABEL}, found {labels[at].item()} at index {at}")


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


def _check_values(name: str, values: torch.Tensor, low: float, high: float, remedy: str) -> None:
    """Raise ValueError for the first value that is not finite or outside low .. high."""
    if not values.numel():
        return
    # Minimum and maximum take one fast pass each and propagate NaN; only on failure is the index searched.
    # numpy on the CPU: torch would wake its thread pool.
    if values.device.type == "cpu" and values.dtype in (torch.float32, torch.float64):
        smallest, largest = values.numpy().min(), values.numpy().max()
    else:
        smallest, largest = (bound.item() for bound in torch.aminmax(values))
    if smallest >= low and largest <= high and smallest > -math.inf and largest < math.inf:
        return
    bad = ~(torch.isfinite(values) & (values >= low) & (values <= high))
    index = tuple(torch.nonzero(bad)[0].tolist())
    found = values[index].item()
    if not math.isfinite(found):
        raise ValueError(f"{name}: expected finite values, found {found} at index {index}")
    wanted = "0 or more" if high == math.inf else f"values from {low:g} to {high:g}"
    raise ValueError(f"{name}: expected {wanted}, found {found:g} at index {index}; remedy: {remedy}")
