"""Height of the images: the largest whose training fits half of the machine's memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..data import memory

MOST_LINES = 960
LEAST_LINES = 64
_BASE = 1.0e9  # bytes of a process with 60,000 Gaussians and small images
_CACHE = 1 << 30  # training caches images as floats up to this size
PIXELS = 2 * memory.GB  # default of data.memory
_PER_CAMERA_PIXEL = 64  # bytes: background images and the plane sweep
_STEP = 8  # lines


@dataclass(frozen=True)
class Size:
    """Chosen height of the images.

    Attributes:
        lines: Height in pixels; smaller images keep their size.
        training_bytes: Estimated memory of training.
        machine_bytes: Memory of this machine.
    """

    lines: int
    training_bytes: float
    machine_bytes: float


def choose(sizes: Sequence[tuple[int, int]], counts: Sequence[int], lines: int | None) -> Size:
    """Choose the height of the images.

    Args:
        sizes: Width and height of each camera's frames.
        counts: Number of training images of each camera.
        lines: Requested height, or None.
    """
    machine = memory.total()
    if lines is not None:
        return Size(lines, training_memory(sizes, counts, lines), machine)
    lines = min(MOST_LINES, max(height for _, height in sizes))
    while lines > LEAST_LINES and training_memory(sizes, counts, lines) > machine / 2:
        lines -= _STEP
    return Size(lines, training_memory(sizes, counts, lines), machine)


def scaled(size: tuple[int, int], lines: int) -> tuple[int, int]:
    """Return width and height of an image that is reduced to a number of lines."""
    width, height = size
    if height <= lines:
        return size
    return max(1, round(width * lines / height)), lines


def training_memory(sizes: Sequence[tuple[int, int]], counts: Sequence[int], lines: int) -> float:
    """Return an estimate of the memory of training, bytes.

    Images take three bytes per pixel, masks one or two, and a cache four times the images as long as it fits; all of
    them at most `PIXELS`.
    """
    pixels = [width * height for width, height in (scaled(size, lines) for size in sizes)]
    images = 3 * sum(count * area for count, area in zip(counts, pixels, strict=True))
    cache = 4 * images if 4 * images <= _CACHE else 0
    return _BASE + min(images * 4 / 3 + cache, PIXELS) + _PER_CAMERA_PIXEL * sum(pixels)
