"""Label of each Gaussian by a vote of the masks.

Notation: N Gaussians, C classes: class 0 is the background, class k the k-th object.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from ...render.segment_weights import segment_weights
from ...scene.sampling import spread
from ..representations.fused_posing import PosedSplats
from ..train_views import MASK, TrainView, in_turn

VOTE_VIEWS = 80


def votes(
    views: Sequence[TrainView], pose: Callable[[TrainView], PosedSplats], classes: dict[int, int], count: int
) -> Tensor:
    """Return the contribution of each Gaussian to the mask pixels of each class.

    Args:
        views: Training views; at most `VOTE_VIEWS` with a mask are used, spread evenly.
        pose: Returns the splats of a view.
        classes: Class of each object id; other ids do not vote.
        count: Number of Gaussians, N.

    Returns:
        Sums of blending weights, pixels, on the CPU. [N, C]
    """
    kinds = max(classes.values(), default=0) + 1
    weights = torch.zeros(count, kinds)
    for view in in_turn(spread([v for v in views if v.has_mask], VOTE_VIEWS), MASK):
        with torch.no_grad():
            splats = pose(view)
        target = class_map(view, classes, splats.means.device)
        given = (splats.means, splats.quats, splats.scales, splats.opacities)
        weights += torch.from_numpy(segment_weights(*given, view.camera, target, kinds).T.toarray())
    return weights


def elect(weights: Tensor, fallback: Tensor) -> Tensor:
    """Return the class with most `votes` for each Gaussian, or its ``fallback`` [N] without votes. [N] int64"""
    return torch.where(weights.amax(1) > 1e-3, weights.argmax(1), fallback)


def class_map(view: TrainView, classes: dict[int, int], device: torch.device | str = "cpu") -> Tensor:
    """Return the class of each pixel, -1 for ids without a class. [H, W] int64"""
    mask = view.mask
    assert mask is not None
    table = np.full(max(int(mask.max(initial=0)), *classes) + 1, -1, np.int64)
    table[list(classes)] = list(classes.values())
    return torch.from_numpy(table[mask]).to(device, non_blocking=True)
