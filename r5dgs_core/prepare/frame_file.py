"""Frames as image files: upright 8-bit sRGB pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from .. import errors, extras
from ..data import file_kinds, images


def size(path: Path) -> tuple[int, int]:
    """Return width and height of a frame, upright, pixels."""
    if path.suffix.lower() in file_kinds.HEIC:
        return _open_heic(path).size
    width, height, _ = images.size(path)
    return (height, width) if orientation(path) >= 5 else (width, height)


def read(path: Path) -> np.ndarray:
    """Read a frame, upright, transparent pixels on white. [H, W, 3] uint8

    Raises:
        DatasetError: The file is damaged.
        BackendError: The package for HEIC is missing.
    """
    if path.suffix.lower() in file_kinds.HEIC:
        return np.asarray(_open_heic(path).convert("RGB"))
    pixels = images.to_uint8(images.composite(images.to_rgba(images.read(path))))
    return upright(pixels, orientation(path))


def orientation(path: Path) -> int:
    """Return the Exif orientation of an image, 1 to 8; 1 is upright."""
    source = oiio.ImageInput.open(str(path))
    if source is None:
        return 1
    value = source.spec().get_int_attribute("Orientation", 1)
    source.close()
    return value if 1 <= value <= 8 else 1


def upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Undo an Exif orientation. [H, W, C]"""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def _open_heic(path: Path):
    with extras.required("HEIC frames", "heic"):
        import PIL.Image
        import pillow_heif
    pillow_heif.register_heif_opener()
    try:
        picture = PIL.Image.open(path)
        picture.load()
    except (OSError, ValueError, SyntaxError) as error:
        raise errors.DatasetError(
            f"{path}: the image cannot be decoded ({error}); copy it again", code="D12"
        ) from error
    return picture
