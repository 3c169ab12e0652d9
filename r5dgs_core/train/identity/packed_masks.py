"""Discovered masks, packed into one compressed tensor for the checkpoint."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ...errors import CheckpointError
from ..checkpoint_content import DISCOVERED_MASKS

PHASE = "discovery"  # event and phase of the discovery in the progress


def pack(masks: Sequence[np.ndarray]) -> Tensor:
    """Pack masks into bytes. [H, W] each -> [B] uint8"""
    content = b"".join(np.ascontiguousarray(mask, "<u2").tobytes() for mask in masks)
    return torch.from_numpy(np.frombuffer(zlib.compress(content), np.uint8).copy())


def unpack(packed: Tensor, sizes: Sequence[tuple[int, int]]) -> list[np.ndarray]:
    """Unpack masks from `pack`.

    Args:
        packed: The bytes. [B] uint8
        sizes: Height and width of each mask.

    Returns:
        Object ids per pixel. [H, W] uint8 if they fit, else uint16

    Raises:
        CheckpointError: The bytes are damaged, or belong to masks of other sizes.
    """
    ends = np.cumsum([0, *(height * width for height, width in sizes)])
    try:
        inflate = zlib.decompressobj()
        # Decompress at most one pixel more than expected, which is enough to detect a surplus.
        values = np.frombuffer(inflate.decompress(packed.numpy().tobytes(), 2 * int(ends[-1]) + 2), "<u2")
        if not inflate.eof and not inflate.unconsumed_tail:
            raise ValueError("incomplete")
    except (zlib.error, ValueError) as error:
        raise CheckpointError(f"'{DISCOVERED_MASKS}': damaged ({error}); train again with --overwrite") from None
    if len(values) != ends[-1]:
        raise CheckpointError(
            f"'{DISCOVERED_MASKS}': expected {ends[-1]} pixels, found {len(values)}; train again with --overwrite"
        )
    kind = np.uint8 if values.max(initial=0) < 256 else np.uint16
    values = values.astype(kind)
    return [values[a:b].reshape(size) for a, b, size in zip(ends, ends[1:], sizes, strict=False)]
