"""Writers of masks and render passes with the standard library: greyscale PNG and float OpenEXR.

Blender, OpenImageIO and compositors read both. EXR channels named LAYER.PASS.CHANNEL, such as ``ViewLayer.Depth.Z``,
match Blender's own multilayer files.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from .. import atomic_files

_ROWS_PER_BLOCK = 16  # rows per block of an EXR with ZIP compression
_ZIP, _FLOAT = 3, 2
_LONG_NAMES = 1 << 10


def write_png(path: str | Path, pixels: np.ndarray) -> Path:
    """Write integers as a PNG, as from `png`, atomically, and return the path."""
    content = png(pixels)
    atomic_files.write(path, content)
    return Path(path)


def png(pixels: np.ndarray) -> bytes:
    """Content of a greyscale or RGB PNG.

    Args:
        pixels: Top row first. [H, W] or [H, W, 3] uint8 or uint16
    """
    if pixels.shape[2:] not in ((), (3,)) or pixels.dtype not in (np.uint8, np.uint16) or pixels.size == 0:
        raise ValueError(
            f"pixels: expected [H, W] or [H, W, 3] of uint8 or uint16, got {pixels.shape} of {pixels.dtype}"
        )
    height, width = pixels.shape[:2]
    depth = 8 * pixels.dtype.itemsize
    lines = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder(">")).view(np.uint8).reshape(height, -1)
    filtered = np.concatenate([np.zeros((height, 1), np.uint8), lines], axis=1)  # filter "none" before each line
    content = b"\x89PNG\r\n\x1a\n"
    content += _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, 2 * (pixels.ndim == 3), 0, 0, 0))
    return content + _chunk(b"IDAT", zlib.compress(filtered.tobytes(), 6)) + _chunk(b"IEND", b"")


def write_exr(path: str | Path, channels: Mapping[str, np.ndarray]) -> Path:
    """Write channels as one OpenEXR image of 32-bit floats, losslessly compressed, atomically; return the path.

    Args:
        path: Target file.
        channels: Values by name, top row first, all of one size. [H, W] each
    """
    names = sorted(channels)  # order required by the format
    planes = [np.ascontiguousarray(channels[name], "<f4") for name in names]
    if not planes or any(plane.ndim != 2 or plane.size == 0 or plane.shape != planes[0].shape for plane in planes):
        raise ValueError(f"channels: expected [H, W] each, got {[plane.shape for plane in planes]}")
    height, width = planes[0].shape
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    listed = b"".join(name.encode() + b"\0" + struct.pack("<iB3xii", _FLOAT, 0, 1, 1) for name in names) + b"\0"
    header = struct.pack("<II", 20000630, 2 | (_LONG_NAMES if max(map(len, names)) > 31 else 0))
    header += _attribute("channels", "chlist", listed) + _attribute("compression", "compression", bytes([_ZIP]))
    header += _attribute("dataWindow", "box2i", window) + _attribute("displayWindow", "box2i", window)
    header += _attribute("lineOrder", "lineOrder", b"\0")
    header += _attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0))
    header += _attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0))
    header += _attribute("screenWindowWidth", "float", struct.pack("<f", 1.0)) + b"\0"
    lines = np.stack(planes, axis=1).reshape(height, -1).view(np.uint8)  # by row, then by channel
    blocks = []
    for top in range(0, height, _ROWS_PER_BLOCK):
        packed = _pack(lines[top : top + _ROWS_PER_BLOCK].reshape(-1))
        blocks.append(struct.pack("<ii", top, len(packed)) + packed)
    start = len(header) + 8 * len(blocks)
    offsets = start + np.concatenate([[0], np.cumsum([len(block) for block in blocks])[:-1]])
    atomic_files.write(path, header + offsets.astype("<u8").tobytes() + b"".join(blocks))
    return Path(path)


def _chunk(kind: bytes, data: bytes) -> bytes:
    """PNG chunk: length, kind, data, checksum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _attribute(name: str, kind: str, value: bytes) -> bytes:
    """EXR header attribute."""
    return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value


def _pack(data: np.ndarray) -> bytes:
    """Compress a block with EXR's ZIP: even and odd bytes apart, differences, deflate; stored if not smaller."""
    apart = np.concatenate([data[::2], data[1::2]])
    packed = zlib.compress(np.concatenate([apart[:1], np.diff(apart) + np.uint8(128)]).tobytes(), 4)
    return packed if len(packed) < data.size else data.tobytes()
