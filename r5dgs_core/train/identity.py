"""Which object each Gaussian belongs to: a vote of the masks, and identity encodings with their classifier.

Both run on finished, frozen geometry. The vote gives one label per Gaussian; the encodings, rendered and classified per
pixel, follow the masks' edges more closely than labels can (Gaussian Grouping).

Notation: N Gaussians, C classes: class 0 is the background, class k the k-th object.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..raster import rasterize_splats
from ..scene.scene import IDENTITY_DIM
from .config import IdentitySection
from .posing import Splats
from .views import TrainView, spread

VOTE_VIEWS = 80


def vote(
    views: list[TrainView], pose: Callable[[TrainView], Splats], classes: dict[int, int], fallback: Tensor
) -> Tensor:
    """Class of each Gaussian: the one whose mask pixels it contributes most to.

    Args:
        views: Training views; those without a mask are passed over, and a spread of 80 of the rest is used.
        pose: Splats of a view.
        classes: Class of each object id; ids that are not in it do not vote.
        fallback: Class of Gaussians that no mask pixel shows. [N]

    Returns:
        The classes. [N] int64
    """
    masked = spread([v for v in views if v.mask is not None], VOTE_VIEWS)
    count = max(classes.values(), default=0) + 1
    weights = torch.zeros(len(fallback), count)
    for view in masked:
        target = class_map(view, classes)
        one_hot = F.one_hot(target.clamp(min=0), count).float() * (target >= 0)[..., None]
        with torch.no_grad():
            splats = pose(view)
        channels = torch.zeros(len(fallback), count, requires_grad=True)
        image = _rasterize(splats, channels, view)
        (gradient,) = torch.autograd.grad((image * one_hot).sum(), channels)
        weights += gradient
    return torch.where(weights.amax(1) > 1e-3, weights.argmax(1), fallback)


def train_encodings(
    views: list[TrainView],
    pose: Callable[[TrainView], Splats],
    classes: dict[int, int],
    labels: Tensor,
    section: IdentitySection,
    generator: torch.Generator,
    progress: Callable[[int, float], None] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Train identity encodings and their linear classifier against the masks.

    The encodings start at their label's row of the classifier, so that the first rendered map is already the labels'.

    Args:
        views: Training views with masks.
        pose: Splats of a view.
        classes: Class of each object id.
        labels: Class of each Gaussian to start from. [N]
        section: Steps and rates.
        generator: Source of the draws.
        progress: Called with step and loss.

    Returns:
        Encodings [N, 16], classifier weight [C, 16] and bias [C].

    Source: Gaussian Grouping (Ye et al. 2024), Eq. 2 to 4: pixel cross-entropy divided by ln C; without its 3D losses,
        which cost accuracy where masks are clean.
    """
    masked = [v for v in views if v.mask is not None]
    count = max(classes.values()) + 1
    directions = torch.randn(max(count, IDENTITY_DIM), IDENTITY_DIM, generator=generator)
    weight = torch.linalg.qr(directions).Q[:count].clone() if count <= IDENTITY_DIM else directions[:count]
    weight = (2 * weight / weight.norm(dim=1, keepdim=True)).requires_grad_(True)
    # Half of what a solid pixel of an object answers: where nothing is drawn, or less than half, it is background.
    bias = torch.zeros(count)
    bias[0] = 2.0
    bias.requires_grad_(True)
    encodings = weight.detach()[labels].clone().requires_grad_(True)
    optimizer = torch.optim.Adam(
        [
            {"params": [encodings], "lr": section.rate},
            {"params": [weight, bias], "lr": section.classifier_rate},
        ],
        fused=True,
    )
    queue: list[int] = []
    for step in range(section.iterations):
        queue = queue or torch.randperm(len(masked), generator=generator).tolist()
        view = masked[queue.pop()]
        target = class_map(view, classes)
        with torch.no_grad():
            splats = pose(view)
        image = _rasterize(splats, encodings, view)
        logits = image.reshape(-1, IDENTITY_DIM) @ weight.T + bias
        loss = F.cross_entropy(logits, target.reshape(-1), ignore_index=-1) / math.log(max(count, 2))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if progress is not None:
            progress(step + 1, float(loss.detach()))
    return encodings.detach(), weight.detach(), bias.detach()


def class_map(view: TrainView, classes: dict[int, int]) -> Tensor:
    """Class of each pixel, -1 where the mask's id has none. [H, W] int64"""
    assert view.mask is not None
    target = np.full(view.mask.shape, -1, np.int64)
    for object_id, row in classes.items():
        target[view.mask == object_id] = row
    return torch.from_numpy(target)


def _rasterize(splats: Splats, channels: Tensor, view: TrainView) -> Tensor:
    return rasterize_splats(
        splats.means.detach(),
        splats.quats.detach(),
        splats.scales.detach(),
        splats.opacities.detach(),
        channels,
        view.camera,
    ).image
