"""Training views that leave out the regions which move although no mask names them (`data.unexplained`).

The pixels of such a region have no effect on the loss, and their masks are unknown.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from ..config.config import Config
from ..data import masks, unexplained
from ..data.unexplained import UsualColors
from . import checkpoint_content
from .checkpoint import Checkpoint
from .train_views import IMAGE, MASK, TrainView, in_turn

log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Decision:
    """Decision on the unexplained regions of a run.

    Attributes:
        share: Mean share of the unexplained pixels in the images of the fixed cameras.
        on: True if the regions are left out.
    """

    share: float
    on: bool

    def tensor(self) -> Tensor:
        """Return the decision as a tensor of a checkpoint: share, and 1 if the regions are left out. [2]"""
        return torch.tensor([self.share, float(self.on)], dtype=torch.float64)

    @classmethod
    def of(cls, tensor: Tensor) -> Decision:
        """Return the decision of a `tensor`."""
        share, on = tensor.tolist()
        return cls(share, bool(on))


def decide(
    views: Sequence[TrainView], config: Config, state: Checkpoint | None = None
) -> tuple[list[TrainView], Decision | None]:
    """Return the views, without unexplained regions if there are more of them than ``init.unexplained``.

    Args:
        views: Training views.
        config: Configuration of the run.
        state: Checkpoint from which the run continues. Its decision is kept; a release that made none trained on whole
            images.

    Returns:
        The same views if the regions are few; and the decision, None if no fixed camera has enough frames with masks or
        the user has switched the search off.
    """
    wanted = config.needs.unexplained_regions
    stored = None if state is None else state.tensors.get(checkpoint_content.UNEXPLAINED)
    earlier = None if stored is None else Decision.of(stored)
    if wanted == "off" or (state is not None and (earlier is None or not earlier.on)):
        return list(views), earlier
    usual = unexplained.of_cameras([view for view in views if view.has_mask], _read)
    if not usual:
        return list(views), None
    if earlier is None:
        share = float(np.mean([one.share for one in usual.values()]))
        earlier = Decision(share, wanted == "on" or share > config.init.unexplained)
    done = "left out" if earlier.on else "trained"
    log.info("regions that no mask explains: %.1f %% of the pixels; %s", 100 * earlier.share, done)
    return _without(views, usual) if earlier.on else list(views), earlier


def _read(views: Sequence[TrainView]) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
    for view in in_turn(views, IMAGE, MASK):
        yield view.image, view.mask


def _without(views: Sequence[TrainView], usual: Mapping[str, UsualColors]) -> list[TrainView]:
    """Return the views with their unexplained regions, in which their masks are unknown."""
    result = []
    for view in views:
        if view.has_mask and view.camera.name in usual:
            region = _Region(view, usual[view.camera.name])
            mask = functools.partial(_unknown_in, view, region)
            view = dataclasses.replace(view, load_mask=mask, load_unexplained=region)
        result.append(view)
    return result


class _Region:
    """Unexplained region of a view, found when it is used first and kept in packed blocks."""

    def __init__(self, view: TrainView, usual: UsualColors):
        self._view, self._usual = view, usual
        self._packed: np.ndarray | None = None

    def __call__(self) -> np.ndarray:
        """Return the mask of the region. [H, W] bool"""
        height, width = self._usual.known.shape
        if self._packed is None:
            self._packed = np.packbits(self._usual.blocks(self._view.image, self._view.mask))
        blocks = np.unpackbits(self._packed, count=height * width).astype(bool).reshape(height, width)
        return unexplained.enlarged(blocks, self._view.camera.height, self._view.camera.width)


def _unknown_in(view: TrainView, region: _Region) -> np.ndarray:
    """Return the object ids of a view, unknown in a region. [H, W] uint16"""
    mask = view.mask
    assert mask is not None
    return np.where(region(), np.uint16(masks.UNKNOWN), mask.astype(np.uint16))
