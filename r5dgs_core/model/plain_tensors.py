"""Plain tensors: the only ones that are accepted from files of tensors."""

from __future__ import annotations

from collections.abc import Collection

import torch
from torch import Tensor


def fault(tensor: Tensor, dtypes: Collection[torch.dtype] | None = None) -> str:
    """Return what is wrong with a tensor of a file; "" for a dense one of real numbers that do not share memory.

    Args:
        tensor: The tensor.
        dtypes: Accepted types of numbers; all real ones if None.
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
    """Return True if two elements share memory, as those of an axis with stride 0 do."""
    end = 1
    for stride, length in sorted(zip(tensor.stride(), tensor.shape, strict=True)):
        if length > 1:
            if stride < end:
                return True
            end = stride * length
    return False
