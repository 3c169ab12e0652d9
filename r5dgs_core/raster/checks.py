"""Checks of the rasterizer's inputs; every message names the input, what was expected and what was found."""

from __future__ import annotations

import math
from typing import Any

import torch

from ..scene import cameras
from ..scene.cameras import Camera


def check_splats(means, quats, scales, opacities, channels, camera, background, labels) -> None:
    """Raise ValueError or TypeError for the first input with an invalid type, shape, dtype, device or value."""
    inputs = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "channels": channels}
    for name, tensor in inputs.items():
        check_tensor(name, tensor)
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
        check_background(background, means, camera, channels.shape[-1])
        inputs["background"] = background.to(means.dtype)
    if labels is not None:
        _check_labels(labels, means)
    for name, tensor in inputs.items():
        _check_values(name, tensor.detach(), *_RANGES.get(name, (-math.inf, math.inf, "")))


def check_appearance(means: Any, camera: Camera, colors: Any, features: Any, background: Any) -> None:
    """Raise ValueError or TypeError for the first invalid input of `rasterizer.rasterize` that is not a splat's."""
    check_tensor("means", means)
    cameras.check(camera)
    if colors is not None:
        check_companion("colors", colors, means, (len(means), 3))
    if features is not None:
        check_companion("features", features, means, (len(means), "F"))
    if background is not None:
        check_background(background, means, camera, 3)


# Bounds of inputs with a limited range, and the remedy.
_RANGES: dict[str, tuple[float, float, str]] = {
    "scales": (0.0, math.inf, "pass exp(log_scales)"),
    "opacities": (0.0, 1.0, "pass sigmoid(opacity_logits)"),
}


def check_tensor(name: str, value: Any) -> None:
    if not isinstance(value, torch.Tensor):
        raise TypeError(f"{name}: expected a tensor, got {type(value).__name__}; remedy: torch.as_tensor({name})")


def _check_device(name: str, tensor: torch.Tensor, means: torch.Tensor) -> None:
    if tensor.device != means.device:
        raise ValueError(f"{name}: expected a tensor on {means.device}, as the means are, got one on {tensor.device}")


def check_companion(name: str, tensor: Any, means: torch.Tensor, shape: tuple[int, int | str]) -> None:
    """Raise unless the value is a tensor on the device of the means with the given shape; a str matches any size."""
    check_tensor(name, tensor)
    if tensor.ndim != 2 or any(isinstance(b, int) and a != b for a, b in zip(tensor.shape, shape, strict=True)):
        raise ValueError(f"{name}: expected shape ({shape[0]}, {shape[1]}), got {tuple(tensor.shape)}")
    _check_device(name, tensor, means)


def check_background(background: Any, means: torch.Tensor, camera: Camera, depth: int) -> None:
    """Raise unless the value is a background for an image with ``depth`` channels."""
    check_tensor("background", background)
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
    check_tensor("labels", labels)
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
