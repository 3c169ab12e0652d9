"""A body that crosses the pictures of a data set although no mask names it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import images

COLOR = np.array([0.15, 0.1, 0.6])
TALL, STEPS = 0.4, 6  # height of the body, as a share of the image's; number of its places beside each other


def place(view: datasets.View, number: int) -> tuple[slice, slice]:
    """Return the rows and columns that the body covers in a view with the given number of its camera."""
    height, width = view.camera.height, view.camera.width
    wide = width // STEPS
    return slice(0, int(TALL * height)), slice(number % STEPS * wide, (number % STEPS + 1) * wide)


def numbers(dataset: datasets.Dataset) -> list[int]:
    """Return the number of each training view among those of its camera, by time."""
    counts: dict[str, int] = {}
    result = []
    for view in dataset.train:
        result.append(counts.get(view.camera.name, 0))
        counts[view.camera.name] = result[-1] + 1
    return result


def add(source: Path, folder: Path) -> datasets.Dataset:
    """Copy a data set, draw the body into its training images, and return the copy."""
    shutil.copytree(source, folder)
    dataset = datasets.read(folder)
    for view, number in zip(dataset.train, numbers(dataset), strict=True):
        pixels = images.read_raw(view.image_path).copy()
        mask = datasets.load_mask(view)
        assert mask is not None
        hidden = np.zeros(mask.shape, bool)
        hidden[place(view, number)] = True
        pixels[hidden & (mask == 0), :3] = np.round(255 * COLOR)
        images.write_png(view.image_path, pixels)
    return datasets.read(folder)
