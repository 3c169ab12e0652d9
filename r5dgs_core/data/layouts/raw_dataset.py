"""The `RawDataset` dataclass, which the reader of each layout returns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # a layout is detected before numpy is imported
    import numpy as np

    from ..transforms import Entry


@dataclass(frozen=True)
class RawDataset:
    """Frames and cameras of a data set, before images and masks are looked up.

    Attributes:
        entries: Frames of the splits "train", "val" and "test".
        header: Keys as at the top of a camera file, for example ``world_convention``, ``frames_per_unit`` or ``fps``.
        image_root: Folder that the frames' file paths are relative to.
        files: The files that were read, for the data set's digest.
        points: Points of a reconstruction, world. [P, 3] float64 or None
        colors: Their colours, sRGB in [0, 1]. [P, 3] float32 or None
    """

    entries: dict[str, list[Entry]]
    header: dict[str, Any]
    image_root: Path
    files: tuple[Path, ...]
    points: np.ndarray | None = None
    colors: np.ndarray | None = None
