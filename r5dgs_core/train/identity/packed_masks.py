"""Discovered masks, compressed: one by one in memory, and packed into one tensor for the checkpoint."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from typing import overload

import numpy as np
import torch
from torch import Tensor

from ...errors import CheckpointError
from ..checkpoint_content import DISCOVERED_MASKS

PHASE = "discovery"  # event and phase of the discovery in the progress
PIECE = 1 << 14  # bytes that are decompressed at once, into at most a thousand times as many
LEVEL = 1  # compression of masks in memory, which are read often


class CompressedMasks(Sequence[np.ndarray]):
    """Masks that are compressed in memory; each access decompresses one.

    The elements are object ids per pixel: [H, W] uint8 if the ids of all masks fit, else uint16.
    """

    def __init__(self):
        self._masks: list[tuple[bytes, tuple[int, ...]]] = []
        self._highest = 0

    def append(self, mask: np.ndarray) -> None:
        """Add a mask. [H, W]"""
        self._masks.append((zlib.compress(_content(mask), LEVEL), mask.shape))
        self._highest = max(self._highest, int(mask.max(initial=0)))

    def __len__(self) -> int:
        return len(self._masks)

    @overload
    def __getitem__(self, index: int) -> np.ndarray: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[np.ndarray]: ...

    def __getitem__(self, index: int | slice) -> np.ndarray | Sequence[np.ndarray]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        content, shape = self._masks[index]
        values = np.frombuffer(zlib.decompress(content), "<u2").reshape(shape)
        return values.astype(np.uint8 if self._highest < 256 else np.uint16)


def pack(masks: Sequence[np.ndarray]) -> Tensor:
    """Pack masks into bytes. [H, W] each -> [B] uint8"""
    deflate = zlib.compressobj()
    content = b"".join([*(deflate.compress(_content(mask)) for mask in masks), deflate.flush()])
    return torch.from_numpy(np.frombuffer(content, np.uint8).copy())


def unpack(packed: Tensor, sizes: Sequence[tuple[int, int]]) -> CompressedMasks:
    """Unpack masks from `pack`.

    Args:
        packed: The bytes. [B] uint8
        sizes: Height and width of each mask.

    Raises:
        CheckpointError: The bytes are damaged, or belong to masks of other sizes.
    """
    found, rest, pixels = CompressedMasks(), bytearray(), 0
    expected = sum(height * width for height, width in sizes)
    try:
        for piece in _inflated(packed.numpy().tobytes()):
            rest += piece
            pixels += len(piece) // 2
            while len(found) < len(sizes) and len(rest) >= 2 * np.prod(sizes[len(found)]):
                size = sizes[len(found)]
                count = 2 * size[0] * size[1]
                found.append(np.frombuffer(bytes(rest[:count]), "<u2").reshape(size))
                del rest[:count]
            if pixels > expected:
                break
    except (zlib.error, ValueError) as error:
        raise CheckpointError(f"'{DISCOVERED_MASKS}': damaged ({error}); train again with --overwrite") from None
    if pixels != expected:
        raise CheckpointError(
            f"'{DISCOVERED_MASKS}': expected {expected} pixels, found {pixels}; train again with --overwrite"
        )
    return found


def _content(mask: np.ndarray) -> bytes:
    return np.ascontiguousarray(mask, "<u2").tobytes()


def _inflated(content: bytes) -> Iterator[bytes]:
    """Yield the decompressed bytes in pieces of an even length, so that no piece splits a pixel."""
    inflate, odd = zlib.decompressobj(), b""
    for start in range(0, len(content), PIECE):
        piece = odd + inflate.decompress(content[start : start + PIECE])
        even = len(piece) // 2 * 2
        odd = piece[even:]
        yield piece[:even]
    if not inflate.eof or odd:
        raise ValueError("incomplete")
