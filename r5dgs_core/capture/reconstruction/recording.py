"""Recordings of cameras as reconstruction reads them, and pictures of their static parts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy import ndimage

STILLS = 15  # number of frames in the median picture of a fixed camera
_MOVED = 12  # difference from the median that marks a moving pixel, of 255
_MARGIN = 2  # pixels around moving ones that are left out, at 480 lines
_SHARE = 0.25  # minimum share of the frames in which a moving pixel differs from the median


class Recording(Protocol):
    """Frames of one camera.

    Attributes:
        name: Name of the camera.
        width: Width of its frames in pixels.
        height: Height of its frames in pixels.
        times: Time of each frame in seconds. [F]
    """

    @property
    def name(self) -> str: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def times(self) -> np.ndarray: ...

    def read(self, wanted: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        """Yield index and sRGB pixels [H, W, 3] uint8 of frames, by increasing index."""
        ...


@dataclass(frozen=True, eq=False)
class Still:
    """Picture of the static parts of a fixed camera's view.

    Attributes:
        pixels: Median of the frames. [H, W, 3] uint8
        static: Pixels that hardly change. [H, W] bool
    """

    pixels: np.ndarray
    static: np.ndarray


def spread(count: int, most: int) -> list[int]:
    """Return at most ``most`` indices below ``count``, evenly spread, the first and the last among them."""
    return sorted(set(np.linspace(0, count - 1, min(most, count)).round().astype(int).tolist()))


def still(recording: Recording) -> Still:
    """Return the picture of the static parts of a fixed camera's view.

    A pixel moves if it differs from its median in more than a quarter of the frames, or strongly in any of them.
    """
    frames = np.stack([pixels for _, pixels in recording.read(spread(len(recording.times), STILLS))])
    rows = range(0, recording.height, 64)  # blocks, to bound the memory of the differences
    median = np.concatenate([np.median(frames[:, row : row + 64], axis=0) for row in rows]).astype(np.uint8)
    moving = np.zeros(median.shape[:2], np.float32)
    strong = np.zeros(median.shape[:2], bool)
    for frame in frames:
        difference = np.abs(frame.astype(np.int16) - median).max(2)
        moving += difference > _MOVED
        strong |= difference > 3 * _MOVED
    moved = strong | (moving > _SHARE * len(frames))
    margin = max(1, round(_MARGIN * recording.height / 480))
    return Still(median, ~np.asarray(ndimage.binary_dilation(moved, iterations=margin), bool))
