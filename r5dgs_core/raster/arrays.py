"""Inputs and results of the rasterizer as numpy arrays or torch tensors. Never imports torch."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from ..motion.rotations import Array, array_namespace


def is_tensor(value: Any) -> bool:
    """Return True if a value is a torch tensor."""
    return array_namespace(value) is not np


def need_gradients(*values: Array | None) -> bool:
    """Return True if torch records gradients of any of the values."""
    if not any(getattr(value, "requires_grad", False) for value in values):
        return False
    return sys.modules["torch"].is_grad_enabled()


def device_of(values: Array) -> str:
    """Return the device as torch names it: "cpu", "cuda:0"."""
    return "cpu" if isinstance(values, np.ndarray) else str(values.device)


def takes_kernels(values: Array) -> bool:
    """Return True if numba kernels process the values: arrays, and tensors on the CPU. Others need plain torch."""
    return device_of(values) == "cpu"


def is_float32(values: Array) -> bool:
    """Return True for float32 values of native byte order."""
    return str(values.dtype).removeprefix("torch.") == "float32"


def is_float(values: Array) -> bool:
    """Return True for floating-point values."""
    return values.is_floating_point() if is_tensor(values) else values.dtype.kind == "f"


def is_integer(values: Array) -> bool:
    """Return True for signed or unsigned integers."""
    return str(values.dtype).removeprefix("torch.").lstrip("u").startswith("int")


def to_array(values: Array | None) -> Any:
    """View values on the CPU as a C-contiguous, writable array, as kernels are compiled for; None stays None."""
    if values is None:
        return None
    if is_tensor(values):
        return values.detach().contiguous().numpy()
    return np.require(values, requirements=["C", "A", "W"])


def to_host(values: Array) -> np.ndarray:
    """View or copy values as an array of the same dtype on the CPU; bfloat16 becomes float32."""
    if not is_tensor(values):
        return values
    values = values.detach().cpu()
    return (values.float() if values.dtype.itemsize == 2 and is_float(values) else values).numpy()


def like(values: Any, given: Array, dtype: Any = None) -> Array:
    """Convert values to an array or tensor on the device of another one, without a copy if possible."""
    xp = array_namespace(given)
    return np.asarray(values, dtype) if xp is np else xp.as_tensor(values, dtype=dtype, device=given.device)
