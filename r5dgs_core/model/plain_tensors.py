"""Validation of tensors from files: only plain tensors are accepted."""

from __future__ import annotations

from collections.abc import Collection

import torch
from torch import Tensor


def fault(tensor: Tensor, dtypes: Collection[torch.dtype] | None = None) -> str:
    """Describe the problem with a tensor of a file; returns "" for dense real tensors without shared elements.

    Args:
        tensor: The tensor.
        dtypes: Accepted dtypes; None for all real ones.
    """
    if _is_plain(tensor) and (dtypes is None or tensor.dtype in dtypes):
        return ""
    kind = f"{tensor.dtype}, {tensor.layout}, {tensor.device}".replace("torch.", "")
    return f"expected a dense tensor of real numbers, found one of {kind}"


def _is_plain(tensor: Tensor) -> bool:
    return (
        type(tensor) is Tensor
        and not tensor.is_nested
        and not tensor.is_quantized
        and not tensor.is_complex()
        and tensor.layout == torch.strided
        and tensor.device.type == "cpu"
        and (tensor.numel() == 0 or not _overlaps(tensor))
    )


def _overlaps(tensor: Tensor) -> bool:
    """Return True if two elements share memory, e.g. along an axis with stride 0."""
    end = 1
    for stride, length in sorted(zip(tensor.stride(), tensor.shape, strict=True)):
        if length > 1:
            if stride < end:
                return True
            end = stride * length
    return False
