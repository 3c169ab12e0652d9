"""Object id images: 8 or 16 bit, palette, or one colour per object.

Id 0 is the background, 1 to `MAX_ID` are objects. Pixels with `UNKNOWN` are ignored by losses and metrics.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from .. import errors, findings
from . import images

UNKNOWN = 65535
MAX_ID = UNKNOWN - 1  # largest id in 16 bits
MAX_COLORS = 4096
MAX_BLENDED = 16  # accepted number of colours without a flat 2 x 2 block, such as those of distant objects
_GRAY, _PALETTE, _GRAY_ALPHA = 0, 3, 4  # PNG colour types
_ONE_CHANNEL = (_GRAY, _PALETTE, _GRAY_ALPHA)
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def read(path: Path, colors: Mapping[int, int] | None = None, unknown: int = UNKNOWN) -> np.ndarray:
    """Read an object id image.

    Without ``colors`` the image holds ids: one channel, palette indices, or three equal channels. With ``colors`` it
    holds one colour per object, in any PNG form (also gray and palette, which image tools choose if lossless). Pixels
    with alpha 0 are background.

    Args:
        path: A PNG file.
        colors: Object id of each packed colour (R << 16 | G << 8 | B), from `color_table` of all masks.
        unknown: Value of unknown pixels in the file; ignored with ``colors``.

    Returns:
        Object ids, 0 = background, `UNKNOWN` for unknown pixels. [H, W] int32
    """
    path = Path(path)
    if colors:
        return _colors_to_ids(path, _read_png(path), colors)
    ids = _read_indices(path) if _holds_indices(path) else _read_gray(path)
    ids[ids == unknown] = UNKNOWN
    return ids


def write(path: Path, ids: np.ndarray) -> None:
    """Write an object id image atomically, with 8 bits if sufficient, else 16.

    Args:
        path: A PNG file; its folder is created if missing.
        ids: Object ids, 0 to `MAX_ID`, and `UNKNOWN`. [H, W] integers

    Raises:
        DatasetError: An id exceeds 16 bits, or the file cannot be written.
    """
    low, high = int(ids.min(initial=0)), int(ids.max(initial=0))
    if low < 0 or high > UNKNOWN:
        raise errors.DatasetError(
            f"{path}: expected object ids from 0 to {MAX_ID}, found {low if low < 0 else high}; renumber the objects"
        )
    images.write_png(path, ids.astype(np.uint8 if high < 256 else np.uint16))


def _read_png(path: Path) -> np.ndarray:
    with findings.coded("D17", instead=True):
        return images.read_png(path)


def _read_gray(path: Path) -> np.ndarray:
    pixels = _read_png(path)
    if pixels.shape[2] >= 3 and not _is_gray(pixels):
        raise errors.DatasetError(
            f"{path}: expected one channel of object ids, found colours; convert the mask to one channel or a palette",
            code="D17",
        )
    ids = pixels[..., 0].astype(np.int32)
    if pixels.shape[2] in (2, 4):
        ids[pixels[..., -1] == 0] = 0
    return ids


def color_table(paths: Iterable[Path]) -> dict[int, int]:
    """Detect masks that are coded by colour, and number the colours.

    The masks of a data set are coded by colour if one of them contains a colour other than gray. Black is then 0, and
    all other colours, including grays and white, are 1, 2, ... by packed value.

    Returns:
        Object id of each packed colour; empty if no mask is coded by colour.

    Raises:
        DatasetError: The coding is ambiguous: colours are blended, or masks of one channel and of colours are mixed and
            do not share their colours.
    """
    found: set[int] = set()
    flat: set[int] = set()  # colours with a flat 2 x 2 block
    gray, colored = [], Path()
    for path in map(Path, paths):
        header = _png_header(path)
        pixels = None if header is not None and header[3] in _ONE_CHANNEL else _read_png(path)
        if pixels is None or pixels.shape[2] < 3 or _is_gray(pixels):
            gray.append(path)
        else:
            colored = path
            _collect(path, pixels, found, flat)
    if not found:
        return {}
    for path in gray:
        shown = set(np.unique(_pack(path, _read_png(path))).tolist())
        if foreign := shown - found - {0}:
            color = min(foreign)
            raise errors.DatasetError(
                f"{path}: contains ({color >> 16}, {color >> 8 & 255}, {color & 255}), which masks coded by colour "
                f"like {colored} lack: does it hold ids or colours? Write all masks in one way, best with one channel "
                "of ids",
                code="D19",
            )
    return {0: 0} | {color: i + 1 for i, color in enumerate(sorted(found - {0}))}


def _collect(path: Path, pixels: np.ndarray, found: set[int], flat: set[int]) -> None:
    packed = _pack(path, pixels)
    found.update(np.unique(packed).tolist())
    corner = packed[:-1, :-1]
    equal = (corner == packed[1:, :-1]) & (corner == packed[:-1, 1:]) & (corner == packed[1:, 1:])
    flat.update(np.unique(corner[equal]).tolist())
    blended = len(found) - len(flat)
    if len(found) > MAX_COLORS or (blended > MAX_BLENDED and blended > len(flat)):
        raise errors.DatasetError(
            f"{path}: expected one flat colour per object, found {len(found)} colours in the masks so far, {blended} "
            "of which fill no area; write them without anti-aliasing and without lossy compression, or with one "
            "channel of ids",
            code="D19",
        )


def resize(ids: np.ndarray, width: int, height: int, where: str) -> np.ndarray:
    """Resize an id image to another size of the same aspect ratio, by nearest pixels.

    Args:
        ids: Object ids. [h, w]
        width: New width in pixels.
        height: New height in pixels.
        where: Name of the mask, for errors.

    Returns:
        Object ids. [height, width]
    """
    h, w = ids.shape
    if (h, w) == (height, width):
        return ids
    if abs(w * height - h * width) > max(w, width):  # aspect ratio differs by more than a pixel
        raise errors.DatasetError(
            f"{where}: the mask is {w}x{h}, its image {width}x{height}: not the same shape; "
            "write masks in the size of the images",
            code="D18",
        )
    rows = np.minimum((np.arange(height) + 0.5) * h / height, h - 1).astype(np.intp)
    columns = np.minimum((np.arange(width) + 0.5) * w / width, w - 1).astype(np.intp)
    return np.ascontiguousarray(ids[rows[:, None], columns[None, :]])


def _is_gray(pixels: np.ndarray) -> bool:
    return bool((pixels[..., 0] == pixels[..., 1]).all() and (pixels[..., 1] == pixels[..., 2]).all())


def _pack(path: Path, pixels: np.ndarray) -> np.ndarray:
    """Pack colours as R << 16 | G << 8 | B; gray has three equal channels, transparent pixels are black. [H, W]"""
    if pixels.dtype != np.uint8:
        raise errors.DatasetError(
            f"{path}: expected 8 bits per channel, as masks of this data set are coded by colour, found {pixels.dtype}",
            code="D19",
        )
    channels = (0, 1, 2) if pixels.shape[2] >= 3 else (0, 0, 0)
    red, green, blue = (pixels[..., c].astype(np.int64) for c in channels)
    packed = red << 16 | green << 8 | blue
    return np.where(pixels[..., -1] == 0, 0, packed) if pixels.shape[2] in (2, 4) else packed


def _colors_to_ids(path: Path, pixels: np.ndarray, colors: Mapping[int, int]) -> np.ndarray:
    packed = _pack(path, pixels)
    keys = np.array(sorted(colors), np.int64)
    values = np.array([colors[int(k)] for k in keys], np.int32)
    at = np.minimum(np.searchsorted(keys, packed), len(keys) - 1)
    unknown = keys[at] != packed
    if unknown.any():
        y, x = np.argwhere(unknown)[0]
        color = int(packed[y, x])
        raise errors.DatasetError(
            f"{path}: expected one of the {len(keys)} colours that the masks had when the data set was read, found "
            f"({color >> 16}, {color >> 8 & 255}, {color & 255}) at pixel ({x}, {y}); the mask changed, start again"
        )
    return values[at]


def _holds_indices(path: Path) -> bool:
    """Return True if image libraries would expand the stored numbers: palettes, or gray below 8 bits."""
    header = _png_header(path)
    return header is not None and (header[3] == _PALETTE or (header[3] == _GRAY and header[2] < 8))


def _png_header(path: Path) -> tuple[int, int, int, int, int] | None:
    """Read width, height, bit depth, colour type and interlace of a PNG; returns None for other formats."""
    try:
        with path.open("rb") as file:
            head = file.read(33)
    except OSError as error:
        raise errors.DatasetError(f"{path}: the mask cannot be read ({error.strerror})", code="D17") from error
    if len(head) < 33 or head[:8] != _PNG_SIGNATURE or head[12:16] != b"IHDR":
        return None
    width, height, depth, kind, _, _, interlace = struct.unpack(">IIBBBBB", head[16:29])
    return width, height, depth, kind, interlace


def _read_indices(path: Path) -> np.ndarray:
    """Decode palette and low-bit gray PNGs to their stored numbers, which image libraries expand to colours.

    Source: PNG specification (ISO/IEC 15948), sections 7.2 (packing) and 9.2 (filters), one byte per filter unit.
    """
    data = path.read_bytes()
    header = _png_header(path)
    assert header is not None
    width, height, depth, _, interlace = header
    if interlace:
        raise errors.DatasetError(
            f"{path}: interlaced palette masks are not supported; save the mask without interlacing", code="D17"
        )
    packed, at = bytearray(), 8
    while at + 12 <= len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        if data[at + 4 : at + 8] == b"IDAT":
            packed += data[at + 8 : at + 8 + length]
        at += 12 + length
    if depth not in (1, 2, 4, 8):
        raise errors.DatasetError(f"{path}: expected 1, 2, 4 or 8 bits per pixel, found {depth}", code="D17")
    images.check_size(path, width, height, 1)
    stride = (width * depth + 7) // 8
    size = height * (stride + 1)
    try:
        raw = np.frombuffer(zlib.decompressobj().decompress(bytes(packed), size + 1), np.uint8)
    except zlib.error as error:
        raise errors.DatasetError(
            f"{path}: the mask cannot be decoded ({error}); write it again", code="D17"
        ) from error
    if raw.size != size:
        found = "more" if raw.size > size else raw.size
        raise errors.DatasetError(f"{path}: expected {size} bytes of pixels, found {found}", code="D17")
    lines = raw.reshape(height, stride + 1)
    rows = np.zeros((height, stride), np.uint8)
    above = np.zeros(stride, np.uint8)
    for y in range(height):
        above = rows[y] = _unfilter(int(lines[y, 0]), lines[y, 1:], above)
    if depth < 8:
        bits = np.unpackbits(rows, axis=1)[:, : width * depth].reshape(height, width, depth)
        return (bits @ (1 << np.arange(depth - 1, -1, -1))).astype(np.int32)
    return rows[:, :width].astype(np.int32)


def _unfilter(kind: int, line: np.ndarray, above: np.ndarray) -> np.ndarray:
    if kind == 0:
        return line.copy()
    if kind == 1:
        return np.cumsum(line, dtype=np.uint8)
    if kind == 2:
        return line + above
    out = np.zeros_like(line)
    left = corner = 0
    for x, value in enumerate(line.tolist()):
        up = int(above[x])
        if kind == 3:
            guess = (left + up) // 2
        else:
            p = left + up - corner
            distance_left, distance_up, distance_corner = abs(p - left), abs(p - up), abs(p - corner)
            if distance_left <= distance_up and distance_left <= distance_corner:
                guess = left
            else:
                guess = up if distance_up <= distance_corner else corner
        left = (value + guess) & 255
        corner = up
        out[x] = left
    return out
