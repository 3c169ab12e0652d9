"""Checks of the rasterizer's inputs; every message names the input, the expected and the found content."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..scene import cameras
from ..scene.cameras import Camera
from .arrays import Array, array_namespace, device_of, is_float, is_integer, like, to_host

_MAX_LABEL = (1 << 31) - 1  # ids are int32
# Bounds of inputs with a limited range, and the remedy.
_RANGES: dict[str, tuple[float, float, str]] = {
    "scales": (0.0, math.inf, "pass exp(log_scales)"),
    "opacities": (0.0, 1.0, "pass sigmoid(opacity_logits)"),
}


def check_splats(means, quats, scales, opacities, channels, camera, background, labels, *, values=True) -> None:
    """Raise ValueError or TypeError for the first input with an invalid type, shape, dtype, device or value.

    Without ``values``, values are not read, which takes time if they are on a GPU.
    """
    inputs = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "channels": channels}
    xp = array_namespace(*inputs.values())
    for name, given in inputs.items():
        check_kind(name, given, xp)
        if not is_float(given):
            remedy = f"{name}.astype('float32')" if xp is np else f"{name}.float()"
            raise ValueError(f"{name}: expected floating-point values, got {given.dtype}; remedy: {remedy}")
    n = len(means) if means.ndim else 0
    shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
    for name, given in inputs.items():
        expected = shapes.get(name, (n, channels.shape[-1] if channels.ndim == 2 and channels.shape[-1] else "D >= 1"))
        if tuple(given.shape) != expected:
            wanted = str(expected).replace("'", "")
            raise ValueError(f"{name}: expected shape {wanted}, got {tuple(given.shape)}")
        if given.dtype != means.dtype or device_of(given) != device_of(means):
            raise ValueError(
                f"{name}: expected {means.dtype} on {device_of(means)}, like the means, got {given.dtype} on "
                f"{device_of(given)}; remedy: convert it, or the means"
            )
    cameras.check(camera)
    if background is not None:
        check_background(background, means, camera, channels.shape[-1])
        inputs["background"] = like(background, means, means.dtype)
    if labels is not None:
        _check_labels(labels, means)
    if not values:
        return
    for name, given in inputs.items():
        _check_values(name, given, *_RANGES.get(name, (-math.inf, math.inf, "")))


def check_appearance(means: Any, camera: Camera, colors: Any, features: Any, background: Any) -> None:
    """Raise ValueError or TypeError for the first invalid input of `rasterizer.rasterize` that is not a splat's."""
    check_kind("means", means, array_namespace(means))
    cameras.check(camera)
    if colors is not None:
        check_companion("colors", colors, means, (len(means), 3))
    if features is not None:
        check_companion("features", features, means, (len(means), "F"))
    if background is not None:
        check_background(background, means, camera, 3)


def check_raw(gaussians: Any, colors: Any, features: Any) -> None:
    """Raise ValueError for the first invalid input of `rasterizer.rasterize`, by the caller's names."""
    n = len(gaussians.means)
    given: dict[str, Any] = {
        name: getattr(gaussians, name, None) for name in ("means", "quats", "log_scales", "opacity_logits", "sh")
    }
    derived = {"log_scales": ("scales", (n, 3)), "opacity_logits": ("opacities", (n,))}
    for name, (result, shape) in derived.items():
        if hasattr(gaussians, result):
            del given[name]
        elif given[name] is not None and tuple(given[name].shape) != shape:
            raise ValueError(f"{name}: expected shape {shape}, got {tuple(given[name].shape)}")
    if colors is not None:
        given["sh"] = None
    for name, values in {**given, "colors": colors, "features": features}.items():
        if values is None:
            continue
        values = to_host(values)
        if name == "log_scales":
            with np.errstate(over="ignore"):
                bad, wanted = ~np.isfinite(np.exp(values)), "values with a finite exponential"
        elif name == "opacity_logits":
            bad, wanted = np.isnan(values), "numbers"
        else:
            bad, wanted = ~np.isfinite(values), "finite values"
        if bad.any():
            at = _first(bad)
            raise ValueError(f"{name}: expected {wanted}, found {values[at].item()} at index {at}")


def check_kind(name: str, value: Any, xp: Any) -> None:
    """Raise TypeError unless a value is an array if ``xp`` is numpy, or a tensor if it is torch."""
    if not isinstance(value, np.ndarray if xp is np else xp.Tensor):
        kind, remedy = ("an array", "numpy.asarray") if xp is np else ("a tensor", "torch.as_tensor")
        raise TypeError(f"{name}: expected {kind}, got {type(value).__name__}; remedy: {remedy}({name})")


def check_companion(name: str, values: Any, means: Array, shape: tuple[int, int | str]) -> None:
    """Raise unless the value is of the kind and on the device of the means with the given shape.

    A str in the shape matches any size.
    """
    check_kind(name, values, array_namespace(means))
    if values.ndim != 2 or any(isinstance(b, int) and a != b for a, b in zip(values.shape, shape, strict=True)):
        raise ValueError(f"{name}: expected shape ({shape[0]}, {shape[1]}), got {tuple(values.shape)}")
    _check_device(name, values, means)


def check_background(background: Any, means: Array, camera: Camera, depth: int) -> None:
    """Raise unless the value is a background for an image with ``depth`` channels."""
    xp = array_namespace(means)
    check_kind("background", background, xp)
    if tuple(background.shape) not in {(depth,), (camera.height, camera.width, depth)}:
        raise ValueError(
            f"background: expected shape ({depth},) or ({camera.height}, {camera.width}, {depth}), "
            f"got {tuple(background.shape)}"
        )
    if not is_float(background):
        remedy = "background.astype('float32')" if xp is np else "background.float()"
        raise ValueError(
            f"background: expected floating-point values, got {background.dtype}; remedy: {remedy}, "
            "divided by 255 for 8-bit colours"
        )
    _check_device("background", background, means)


def _check_labels(labels: Any, means: Array) -> None:
    """Raise unless the labels are integers in range, one per Gaussian."""
    check_kind("labels", labels, array_namespace(means))
    if tuple(labels.shape) != (len(means),) or not is_integer(labels):
        raise ValueError(f"labels: expected {len(means)} integers, got {labels.dtype} of shape {tuple(labels.shape)}")
    _check_device("labels", labels, means)
    if labels.dtype.itemsize <= 4 and str(labels.dtype)[-6:] != "uint32" or not len(labels):
        return
    numbers = to_host(labels)
    if numbers.max() > _MAX_LABEL:
        at = int(numbers.argmax())
        raise ValueError(f"labels: expected at most {_MAX_LABEL}, found {numbers[at]} at index {at}")


def _check_device(name: str, values: Array, means: Array) -> None:
    if device_of(values) != device_of(means):
        expected, found = device_of(means), device_of(values)
        raise ValueError(f"{name}: expected a tensor on {expected}, like the means, got one on {found}")


def _check_values(name: str, values: Array, low: float, high: float, remedy: str) -> None:
    """Raise ValueError for the first value that is not finite or outside low .. high."""
    if not math.prod(values.shape):
        return
    # Minimum and maximum take one fast pass each and propagate NaN; only on failure is the index searched.
    # numpy on the CPU: torch would wake its thread pool.
    quick = to_host(values) if device_of(values) == "cpu" else values
    smallest, largest = quick.min().item(), quick.max().item()
    if smallest >= low and largest <= high and smallest > -math.inf and largest < math.inf:
        return
    values = to_host(values)
    index = _first(~(np.isfinite(values) & (values >= low) & (values <= high)))
    found = values[index].item()
    if not math.isfinite(found):
        raise ValueError(f"{name}: expected finite values, found {found} at index {index}")
    wanted = "0 or more" if high == math.inf else f"values from {low:g} to {high:g}"
    raise ValueError(f"{name}: expected {wanted}, found {found:g} at index {index}; remedy: {remedy}")


def _first(mask: np.ndarray) -> tuple[int, ...]:
    """Index of the first True."""
    return tuple(np.argwhere(mask)[0].tolist())
