"""Images of the training views as float tensors on the device of a run."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..data.array_cache import AHEAD
from . import train_views
from .train_views import TrainView

MAX_BYTES = 1 << 30  # maximum size of all tensors
WHOLE = 5  # size of an image in bytes and as floats, relative to that in bytes


class Targets:
    """Images of the views, in [0, 1]; they stay in memory if all of them fit.

    Args:
        views: Training views.
        device: Device of the tensors.
        memory: Maximum memory for the pixels of all views, bytes.
    """

    def __init__(self, views: Sequence[TrainView], device: torch.device, memory: float):
        self._views, self._device = views, device
        size = sum(3 * view.camera.width * view.camera.height for view in views)
        self._keeps = 4 * size <= MAX_BYTES and WHOLE * size <= memory
        self._held: dict[int, Tensor] = {}

    def of(self, index: int) -> Tensor:
        """Return the image of a view. [H, W, 3]"""
        if index in self._held:
            return self._held[index]
        image = self._views[index].image
        target = torch.from_numpy(image).to(self._device, non_blocking=True).float() / 255
        if self._keeps:
            self._held[index] = target
        return target

    def expect(self, queue: Sequence[int], *, masks: bool) -> None:
        """Begin to read the images of the next views of a queue, the next one last, and their masks if they are used.

        Args:
            queue: Indices of views.
            masks: True to read the masks, too.
        """
        following = [self._views[k] for k in reversed(queue[-AHEAD:]) if k not in self._held]
        train_views.expect(following, train_views.IMAGE, *[train_views.MASK] * masks)
