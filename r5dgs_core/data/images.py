"""Reading and writing of images with OpenImageIO.

In memory, colours are display-referred sRGB, float32 in [0, 1], with straight alpha. Float files (EXR) are linear by
convention and are converted to sRGB on reading.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from .. import atomic_files, errors
from ..color import srgb
from . import file_kinds

SUFFIXES = file_kinds.IMAGES
COMPRESSION_LEVEL = 6
# Limits for sizes declared in headers, checked before decoding; a PNG of one colour has about 1000 pixels per byte.
_MAX_PIXELS, _MAX_CHANNELS = 1 << 28, 64
_PIXELS, _PIXELS_PER_BYTE = 1 << 24, 4096
UNREADABLE_SUFFIXES = file_kinds.UNREADABLE
JPEG_QUALITY = 95


def unreadable_kind(path: Path, place: str = "") -> errors.DatasetError:
    """Return the error for an existing file of an unsupported kind.

    Args:
        path: The file.
        place: Place for the message; the path by default.
    """
    kind = path.suffix.lower()
    found = f"{path.name}, of the unreadable kind {kind.removeprefix('.') or 'without suffix'}"
    remedy = "convert it to PNG or JPEG"
    if kind in file_kinds.VIDEOS:
        remedy = "make a data set of the videos with 'r5dgs prepare FOLDER --out DATA'"
    return errors.DatasetError(f"{place or path}: expected an image, found {found}. Remedy: {remedy}", code="D11")


def size(path: Path) -> tuple[int, int, int]:
    """Read width, height and number of channels of an image file from its header."""
    source = _open(path)
    spec = source.spec()
    width, height, channels = spec.width, spec.height, spec.nchannels
    source.close()
    return width, height, channels


def read(path: Path) -> np.ndarray:
    """Read an image as display-referred colour.

    Args:
        path: An 8- or 16-bit file, interpreted as sRGB, or a float file, converted from linear to sRGB.

    Returns:
        Straight-alpha pixels, float32, 8-bit value v as v / 255. Channels as in the file. [H, W, C]
    """
    pixels = read_raw(path)
    if pixels.dtype == np.uint8:
        return pixels.astype(np.float32) / np.float32(255.0)
    if pixels.dtype == np.uint16:
        return pixels.astype(np.float32) / np.float32(65535.0)
    colors = 3 if pixels.shape[2] >= 3 else 1
    pixels = pixels.astype(np.float32)
    if not np.isfinite(pixels).all():
        raise errors.DatasetError(f"{path}: expected finite pixels, found NaN or infinity; render it again", code="D12")
    if pixels.shape[2] in (2, 4):  # the alpha of linear float files is premultiplied
        alpha = pixels[..., -1:]
        pixels[..., :-1] = np.where(alpha > 0, pixels[..., :-1] / np.maximum(alpha, 1e-8), 0.0)
    pixels[..., :colors] = srgb.from_linear(pixels[..., :colors])
    return np.clip(pixels, 0.0, 1.0)


def read_raw(path: Path) -> np.ndarray:
    """Read the stored numbers: uint8, uint16 or float32, not premultiplied by alpha. [H, W, C]"""
    source = _open(path)
    spec = source.spec()
    name = str(spec.format)
    kind = oiio.UINT8 if name == "uint8" else oiio.UINT16 if name == "uint16" else oiio.FLOAT
    pixels = source.read_image(0, 0, 0, spec.nchannels, kind)
    try:
        problem = " ".join(source.geterror().split())
    except UnicodeError:  # the library's message contains raw bytes of the file
        problem = "damaged"
    source.close()
    if pixels is None or problem:
        raise errors.DatasetError(
            f"{path}: the image cannot be decoded ({problem or 'no pixels'}); copy or render it again", code="D12"
        )
    return np.ascontiguousarray(pixels).reshape(spec.height, spec.width, spec.nchannels)


def read_png(path: Path) -> np.ndarray:
    """Read a PNG's stored integers, uint8 or uint16. [H, W, C]"""
    pixels = read_raw(path)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise errors.DatasetError(f"{path}: expected 8 or 16 bits per channel, found {pixels.dtype}")
    return pixels


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Write a PNG atomically.

    Args:
        path: File to write; its folder is created if missing.
        pixels: uint8 or uint16, written unchanged; floats are sRGB in [0, 1] and are rounded to 8 bits. Gray, gray
            with alpha, RGB or RGBA, straight alpha. [H, W] or [H, W, C]
    """
    pixels = np.asarray(pixels)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 2, 3, 4) or 0 in pixels.shape:
        raise ValueError(f"{path}: expected pixels [H, W] or [H, W, 1 to 4], got {pixels.shape}")
    if pixels.dtype.kind == "f":
        pixels = to_uint8(pixels)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path}: expected uint8, uint16 or floats, got {pixels.dtype}")
    _write(Path(path), pixels, {"oiio:UnassociatedAlpha": 1, "png:compressionLevel": COMPRESSION_LEVEL})


def write_jpeg(path: Path, pixels: np.ndarray) -> None:
    """Write a JPEG of quality `JPEG_QUALITY` with full colour resolution, atomically.

    Args:
        path: File to write; its folder is created if missing.
        pixels: sRGB, uint8. [H, W, 3]
    """
    _write(Path(path), pixels, {"Compression": f"jpeg:{JPEG_QUALITY}", "jpeg:subsampling": "4:4:4"})


def write_exr(path: Path, channels: Mapping[str, np.ndarray], attributes: dict[str, int | str]) -> None:
    """Write an OpenEXR image of 32-bit floats, atomically.

    Args:
        path: File to write; its folder is created if missing.
        channels: Values by name. [H, W] each
        attributes: Entries of the header.
    """
    pixels = np.stack([np.asarray(values, np.float32) for values in channels.values()], -1)
    _write(Path(path), pixels, {"compression": "zip", **attributes}, tuple(channels))


def _write(
    path: Path, pixels: np.ndarray, attributes: dict[str, int | str], names: tuple[str, ...] | None = None
) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise errors.DatasetError(f"{path}: cannot write the image: its folder cannot be created ({error})") from error
    height, width, channels = pixels.shape
    kind = {"uint8": oiio.UINT8, "uint16": oiio.UINT16, "float32": oiio.FLOAT}[pixels.dtype.name]
    spec = oiio.ImageSpec(width, height, channels, kind)
    if names is not None:
        spec.channelnames = names
    for name, value in attributes.items():
        spec.attribute(name, value)
    try:
        with atomic_files.replacing_by_name(path) as temporary:
            target = oiio.ImageOutput.create(str(temporary))
            if target is None:
                raise errors.DatasetError(f"{path}: cannot write the image ({oiio.geterror().strip()})")
            good = target.open(str(temporary), spec) and target.write_image(np.ascontiguousarray(pixels))
            problem = target.geterror()  # a full disk is reported only here
            if not good or problem or not target.close():
                problem = " ".join(problem.split()) or "no reason given"
                raise errors.DatasetError(f"{path}: cannot write the image ({problem}); check the free disk space")
    except OSError as error:
        raise errors.DatasetError(f"{path}: cannot write the image ({error})") from error


def to_uint8(pixels: np.ndarray) -> np.ndarray:
    """Convert colours in [0, 1] to 8 bits, clipped and rounded to nearest."""
    return np.rint(np.clip(np.nan_to_num(pixels), 0.0, 1.0) * 255.0).astype(np.uint8)


def to_rgba(pixels: np.ndarray) -> np.ndarray:
    """Convert gray, gray with alpha, RGB or RGBA to RGBA, float32. [H, W, C] -> [H, W, 4]"""
    channels = pixels.shape[2]
    alpha = pixels[..., -1:] if channels in (2, 4) else np.ones_like(pixels[..., :1])
    color = pixels[..., :3] if channels >= 3 else np.repeat(pixels[..., :1], 3, axis=2)
    return np.concatenate([color, alpha], axis=2).astype(np.float32)


def composite(rgba: np.ndarray, background: np.ndarray | None = None) -> np.ndarray:
    """Composite straight-alpha colours on a background.

    Args:
        rgba: Pixels. [H, W, 4]
        background: Background colour, sRGB; white if None. [3]

    Returns:
        Pixels, float32. [H, W, 3]
    """
    behind = np.ones(3, np.float32) if background is None else np.asarray(background, np.float32)
    alpha = rgba[..., 3:4].astype(np.float32)
    return rgba[..., :3].astype(np.float32) * alpha + behind * (1.0 - alpha)


def _open(path: Path):
    path = Path(path)
    if not path.is_file():
        raise errors.DatasetError(f"{path}: the image is missing", code="D10")
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)  # otherwise the reader premultiplies colours by alpha
    try:
        source = oiio.ImageInput.open(str(path), hints)
        reason = "" if source is not None else oiio.geterror().strip() or "unknown format"
    except UnicodeError:  # the library's message contains raw bytes of the file
        source, reason = None, "damaged"
    if source is None:
        raise errors.DatasetError(
            f"{path}: the image cannot be read ({reason}); copy or render it again, or convert it to PNG or JPEG",
            code="D12",
        )
    spec = source.spec()
    try:
        check_size(path, spec.width, spec.height, spec.nchannels)
    except errors.DatasetError:
        source.close()
        raise
    return source


def check_size(path: Path, width: int, height: int, channels: int) -> None:
    """Raise `DatasetError` if an image declares no pixels, or more than a file of its size can hold."""
    size = Path(path).stat().st_size
    most = min(_MAX_PIXELS, _PIXELS + _PIXELS_PER_BYTE * size)
    if min(width, height, channels) < 1 or width * height > most or channels > _MAX_CHANNELS:
        raise errors.DatasetError(
            f"{path}: expected 1 to {most} pixels of up to {_MAX_CHANNELS} channels in a file of {size} bytes, found "
            f"{width} x {height} of {channels}; is it damaged?"
        )
