"""Identity encodings with their linear classifier, trained on the masks while the geometry is frozen.

The encodings, rendered and classified per pixel, follow the edges of the masks more closely than labels of Gaussians
(`label_votes`) can (Gaussian Grouping). `joint_identity` trains them together with the geometry.

Notation: N Gaussians, C classes: class 0 is the background, class k the k-th object.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ...config.config import Config
from ...raster import DRAFT, rasterize_splats
from ...scene.scene import IDENTITY_DIM
from ..representations.fused_posing import PosedSplats
from ..train_views import MASK, TrainView, expect
from . import identity_losses
from .label_votes import class_map


def train_encodings(
    views: Sequence[TrainView],
    pose: Callable[[TrainView], PosedSplats],
    classes: dict[int, int],
    labels: Tensor,
    config: Config,
    means: Tensor,
    generator: torch.Generator,
    progress: Callable[[int, Tensor], None] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Train identity encodings and their linear classifier on the masks.

    Encodings are initialised with their label's row of the classifier, so that the first rendered map equals that of
    the labels.

    Args:
        views: Training views with masks.
        pose: Returns the splats of a view.
        classes: Class of each object id.
        labels: Initial class of each Gaussian. [N]
        config: The run's configuration: steps, rates and weights of the losses.
        means: Centres of the Gaussians, for the losses between neighbours. [N, 3]
        generator: Random generator.
        progress: Called with step and loss.

    Returns:
        Encodings [N, 16], classifier weight [C, 16] and bias [C].

    Source: Gaussian Grouping (Ye et al. 2024), Eq. 2 to 4: pixel cross-entropy divided by ln C. Its 3D losses are off
        by default, as they cost accuracy if masks are clean.
    """
    section = config.identity
    agreement = Agreement(config)
    neighbourhood = identity_losses.Neighbourhood(means) if agreement.counts else None
    masked = [v for v in views if v.has_mask]
    count = max(classes.values()) + 1
    weight, bias = (tensor.to(labels.device) for tensor in distinct_classes(count, generator))
    encodings = weight[labels].clone().requires_grad_(True)
    weight.requires_grad_(True)
    bias.requires_grad_(True)
    rates = (([encodings], section.rate), ([weight, bias], section.classifier_rate))
    optimizer = torch.optim.Adam([{"params": params, "lr": rate} for params, rate in rates], fused=True)
    queue: list[int] = []
    for step in range(section.iterations):
        queue = queue or torch.randperm(len(masked), generator=generator).tolist()
        view = masked[queue.pop()]
        expect([masked[k] for k in queue[-1:]], MASK)
        target = class_map(view, classes, encodings.device)
        with torch.no_grad():
            splats = pose(view)
        image = rasterize(splats, encodings, view)
        loss = identity_losses.pixel_cross_entropy(image, weight, bias, target)
        if neighbourhood is not None and step % section.regularise_every == 0:
            loss = loss + agreement.loss(encodings, weight, bias, neighbourhood, generator)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if progress is not None:
            progress(step + 1, loss.detach())
    return encodings.detach(), weight.detach(), bias.detach()


class Agreement:
    """Weighted sum of L_3d and L_major for sampled Gaussians.

    Args:
        config: The run's configuration.

    Attributes:
        counts: True if at least one of the two has a positive weight.
    """

    def __init__(self, config: Config):
        section, paper = config.identity, config.train.representation == "field"
        self._section = section
        self._majority = section.majority if not paper or config.field.variant == "r5dgs_extra" else 0.0
        self._include_self = paper if section.include_self == "auto" else section.include_self == "on"
        self.counts = max(section.spatial, self._majority) > 0

    def loss(
        self,
        encodings: Tensor,
        weight: Tensor,
        bias: Tensor,
        neighbourhood: identity_losses.Neighbourhood,
        generator: torch.Generator,
    ) -> Tensor:
        """Return the term for a step's loss; only the sampled Gaussians and their neighbours are classified.

        Args:
            encodings: Encodings of all Gaussians. [N, 16]
            weight: Weight of the classifier. [C, 16]
            bias: Bias of the classifier. [C]
            neighbourhood: Neighbourhood of all Gaussians.
            generator: Random generator.
        """
        rows = torch.randint(len(encodings), (self._section.samples,), generator=generator)
        found = neighbourhood.nearest(rows, self._section.neighbours)
        both = torch.cat([rows[:, None], found], dim=1).to(encodings.device, non_blocking=True)
        # index_select sums its gradients in the same order on any number of threads; indexing does not.
        answers = encodings.index_select(0, both.reshape(-1)) @ weight.T + bias
        probabilities = answers.softmax(dim=1).reshape(*both.shape, -1)
        queries, neighbours = probabilities[:, 0], probabilities[:, 1:]
        total = queries.new_zeros(())
        if self._section.spatial > 0:
            divergence = identity_losses.spatial_divergence(queries, neighbours, include_self=self._include_self)
            total = total + self._section.spatial * divergence
        if self._majority > 0:
            total = total + self._majority * identity_losses.majority_distance(queries, neighbours)
        return total


def distinct_classes(count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return a classifier (weight [C, 16], bias [C]) that selects the class whose row fills over half of the pixel."""
    directions = torch.randn(max(count, IDENTITY_DIM), IDENTITY_DIM, generator=generator)
    weight = torch.linalg.qr(directions).Q[:count].clone() if count <= IDENTITY_DIM else directions[:count]
    # Half of the output for a fully covered pixel, so that pixels covered by less are background.
    bias = torch.zeros(count)
    bias[0] = 2.0
    return 2 * weight / weight.norm(dim=1, keepdim=True), bias


def rasterize(splats: PosedSplats, channels: Tensor, view: TrainView) -> Tensor:
    """Blend channels [N, F] over a view without gradients of the geometry. [H, W, F]"""
    return rasterize_splats(
        splats.means.detach(),
        splats.quats.detach(),
        splats.scales.detach(),
        splats.opacities.detach(),
        channels,
        view.camera,
        settings=DRAFT,
    ).image
