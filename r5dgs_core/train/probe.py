"""A look at a few held-out views while training runs, and at the training views after it.

The run's numbers do not depend on it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..data import dataset as datasets
from .train_views import spread

if TYPE_CHECKING:
    from .trainer import Trainer

TRAINING_VIEWS = 150  # that are compared at most


class Probe:
    """Some views of the split ``val``, evenly over their order, in the trainer's coordinates.

    Args:
        trainer: The run; its ``dataset`` gives the views.
        count: Largest number of views.

    Raises:
        DatasetError: An image cannot be read.
    """

    def __init__(self, trainer: Trainer, count: int):
        self._trainer = trainer
        self._views = [
            (view.name, trainer.normalization.camera(view.camera), view.t, _load(view, trainer.behind))
            for view in spread(trainer.dataset.val, count)
        ]

    def __len__(self) -> int:
        return len(self._views)

    @torch.no_grad()
    def psnr(self) -> float:
        """Mean PSNR of the views as they are now, dB, colours in 8 bits; no draw of the run is used up."""
        state = self._trainer.generator.get_state()
        with torch.random.fork_rng(devices=[]):
            found = [psnr(self._trainer.render(camera, t).numpy(), image) for _, camera, t, image in self._views]
        self._trainer.generator.set_state(state)
        return float(np.mean(found))


def training_psnr(
    dataset: datasets.Dataset, behind: np.ndarray | None, draw: Callable[[datasets.View], np.ndarray]
) -> float:
    """Mean PSNR on the training views, or on `TRAINING_VIEWS` of them spread evenly, dB.

    Args:
        dataset: The data set.
        behind: Background of transparent pixels, as for `train_views.load`. [3] or None
        draw: Gives the picture of a view. [H, W, 3]

    Raises:
        DatasetError: An image is missing or cannot be read.
    """
    chosen = spread(dataset.train, TRAINING_VIEWS)
    return float(np.mean([psnr(draw(view), _load(view, behind)) for view in chosen]))


def _load(view: datasets.View, behind: np.ndarray | None) -> np.ndarray:
    """Image of a view on the background of the run. [H, W, 3] uint8"""
    return np.round(datasets.load_image(view, behind) * 255).astype(np.uint8)


def psnr(image: np.ndarray, target: np.ndarray) -> float:
    """PSNR of colours in [0, 1] against 8 bits, dB; at most 99, which equal images have. [H, W, 3]"""
    rounded = np.round(np.clip(image, 0, 1) * 255)
    error = float(np.mean(((rounded - target) / 255) ** 2))
    return min(99.0, -10 * math.log10(max(error, 1e-12)))
