"""Cryptomatte 1.2 encoding of names: hashes, channel values, manifests.

A name is represented by its 32-bit MurmurHash3, whose bits are stored in a float32 channel. The exponent of a hash that
would be infinite, NaN or denormal is changed.
"""

from __future__ import annotations

import json
from collections.abc import Iterable

import numpy as np

HASH = "MurmurHash3_32"
CONVERSION = "uint32_to_float32"


def hash_of(name: str) -> int:
    """MurmurHash3_x86_32 of a name in UTF-8, seed 0, with an exponent valid in float32. In [0, 2^32)."""
    value = _murmur3(name.encode())
    exponent = value >> 23 & 255
    return value ^ (1 << 23) if exponent in (0, 255) else value


def value_of(name: str) -> np.float32:
    """Channel value that represents a name."""
    return np.uint32(hash_of(name)).view(np.float32)


def manifest(names: Iterable[str]) -> str:
    """Manifest of an image: JSON from names to hashes in eight hexadecimal digits."""
    found = {name: f"{hash_of(name):08x}" for name in names}
    return json.dumps(found, separators=(",", ":"), ensure_ascii=False)


def metadata(layer: str, names: Iterable[str]) -> dict[str, str]:
    """Header entries of an image with Cryptomatte channels.

    Args:
        layer: Name of the Cryptomatte layer, i.e. of its passes without their number.
        names: Names that may occur in the image.

    Returns:
        Text by key.
    """
    start = f"cryptomatte/{hash_of(layer):08x}"[: len("cryptomatte/") + 7]
    return {
        f"{start}/name": layer,
        f"{start}/hash": HASH,
        f"{start}/conversion": CONVERSION,
        f"{start}/manifest": manifest(names),
    }


def _murmur3(data: bytes) -> int:
    whole, rest, value = len(data) & ~3, data[len(data) & ~3 :], 0
    for start in range(0, whole, 4):
        value ^= _mix(int.from_bytes(data[start : start + 4], "little"))
        value = ((value << 13 | value >> 19) * 5 + 0xE6546B64) & 0xFFFFFFFF
    if rest:
        value ^= _mix(int.from_bytes(rest, "little"))
    value ^= len(data)
    value = (value ^ value >> 16) * 0x85EBCA6B & 0xFFFFFFFF
    value = (value ^ value >> 13) * 0xC2B2AE35 & 0xFFFFFFFF
    return value ^ value >> 16


def _mix(block: int) -> int:
    block = block * 0xCC9E2D51 & 0xFFFFFFFF
    block = (block << 15 | block >> 17) & 0xFFFFFFFF
    return block * 0x1B873593 & 0xFFFFFFFF
