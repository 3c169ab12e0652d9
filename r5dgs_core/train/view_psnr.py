"""PSNR on held-out views during training, and on the training views after it.

Measuring does not affect the results of the run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..data import dataset as datasets
from ..scene.sampling import spread

if TYPE_CHECKING:
    from .trainer import Trainer

TRAINING_VIEWS = 150  # maximum number of compared training views


class HeldOutPsnr:
    """PSNR on views of the split ``val``, spread evenly.

    Args:
        trainer: The run; its ``dataset`` provides the views.
        count: Maximum number of views.

    Raises:
        DatasetError: An image cannot be read.
    """

    def __init__(self, trainer: Trainer, count: int):
        self._trainer = trainer
        self._views = [
            (
                view.name,
                trainer.normalization.camera(view.camera),
                view.t,
                _in_8_bits(datasets.load_image(view, trainer.behind)),
            )
            for view in spread(trainer.dataset.val, count)
        ]

    def __len__(self) -> int:
        return len(self._views)

    @torch.no_grad()
    def measure(self) -> float:
        """Return the current mean PSNR on the views, dB, for colours of 8 bits. The run's random state is preserved."""
        state = self._trainer.generator.get_state()
        with torch.random.fork_rng(devices=[]):
            found = [
                psnr_8_bit(self._trainer.render(camera, t).cpu().numpy(), image) for _, camera, t, image in self._views
            ]
        self._trainer.generator.set_state(state)
        return float(np.mean(found))


def configured(trainer: Trainer) -> HeldOutPsnr | None:
    """Return the measurement on held-out views; None if there are none or ``train.probe_every`` is 0."""
    section = trainer.config.train
    if section.probe_every == 0 or not trainer.dataset.val:
        return None
    return HeldOutPsnr(trainer, section.probe_views)


def training_psnr(
    dataset: datasets.Dataset,
    behind: np.ndarray | None,
    draw: Callable[[datasets.View], np.ndarray],
    explained: Callable[[datasets.View, np.ndarray], np.ndarray | None],
) -> float:
    """Return the mean PSNR on the training views, or on `TRAINING_VIEWS` of them spread evenly, dB.

    Args:
        dataset: The data set.
        behind: Background of transparent pixels, as for `train_views.load`. [3] or None
        draw: Renders a view. [H, W, 3]
        explained: Returns the pixels of a view to compare, given its image in the colours of its camera; None for all.
            [H, W] bool

    Raises:
        DatasetError: An image is missing or cannot be read.
    """
    found = []
    for view in spread(dataset.train, TRAINING_VIEWS):
        given = datasets.load_given_image(view, behind)
        target = _in_8_bits(datasets.in_scene_colors(view, given))
        found.append(psnr_8_bit(draw(view), target, explained(view, given)))
    return float(np.mean(found))


def _in_8_bits(image: np.ndarray) -> np.ndarray:
    """Convert colours in [0, 1], limited to that range, to 8 bits. [H, W, 3] uint8"""
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def psnr_8_bit(image: np.ndarray, target: np.ndarray, where: np.ndarray | None = None) -> float:
    """Return the PSNR of colours in [0, 1] against 8-bit colours, dB; 99 for equal images.

    Args:
        image: Picture. [H, W, 3]
        target: Image. [H, W, 3] uint8
        where: Mask of the pixels to compare, which is not empty; None for all. [H, W] bool
    """
    squared = ((np.round(np.clip(image, 0, 1) * 255) - target) / 255) ** 2
    error = float(np.mean(squared if where is None else squared[where]))
    return min(99.0, -10 * math.log10(max(error, 1e-12)))
