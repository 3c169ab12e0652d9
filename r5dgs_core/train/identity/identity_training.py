"""Which object each Gaussian belongs to: a vote of the masks, and identity encodings with their classifier.

The vote gives one label per Gaussian; the encodings, rendered and classified per pixel, follow the masks' edges more
closely than labels can (Gaussian Grouping). Both run on finished, frozen geometry; encodings also beside the training
of the geometry (`JointIdentity`).

Notation: N Gaussians, C classes: class 0 is the background, class k the k-th object.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from ...config.config import Config
from ...model.gaussians import Gaussians
from ...raster import rasterize_splats
from ...render.segment_weights import segment_weights
from ...scene import sh_color
from ...scene.scene import IDENTITY_DIM
from ..representations.fused_posing import Splats
from ..train_views import TrainView, spread
from . import identity_losses

VOTE_VIEWS = 80
NEIGHBOURS_EVERY = 300  # steps after which neighbours are looked for anew, where the Gaussians are still the same


def votes(views: list[TrainView], pose: Callable[[TrainView], Splats], classes: dict[int, int], count: int) -> Tensor:
    """What each Gaussian contributes to the mask pixels of each class.

    Args:
        views: Training views; those without a mask are passed over, and a spread of 80 of the rest is used.
        pose: Splats of a view.
        classes: Class of each object id; ids that are not in it do not vote.
        count: Number of Gaussians, N.

    Returns:
        Sums of blending weights, pixels. [N, C]
    """
    kinds = max(classes.values(), default=0) + 1
    weights = torch.zeros(count, kinds)
    for view in spread([v for v in views if v.mask is not None], VOTE_VIEWS):
        target = class_map(view, classes)
        with torch.no_grad():
            splats = pose(view)
        given = (splats.means, splats.quats, splats.scales, splats.opacities)
        weights += torch.from_numpy(segment_weights(*given, view.camera, target, kinds).T.toarray())
    return weights


def elect(weights: Tensor, fallback: Tensor) -> Tensor:
    """Class of each Gaussian, that with most of its `votes`, and the ``fallback`` [N] where it has none. [N] int64"""
    return torch.where(weights.amax(1) > 1e-3, weights.argmax(1), fallback)


def train_encodings(
    views: list[TrainView],
    pose: Callable[[TrainView], Splats],
    classes: dict[int, int],
    labels: Tensor,
    config: Config,
    means: Tensor,
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
        config: Of the run: steps, rates and the weights of the losses.
        means: Centres whose neighbours should agree. [N, 3]
        generator: Source of the draws.
        progress: Called with step and loss.

    Returns:
        Encodings [N, 16], classifier weight [C, 16] and bias [C].

    Source: Gaussian Grouping (Ye et al. 2024), Eq. 2 to 4: pixel cross-entropy divided by ln C. Its 3D losses weigh
        nothing unless asked for: where masks are clean they cost accuracy.
    """
    section = config.identity
    agreement = Agreement(config)
    neighbourhood = identity_losses.Neighbourhood(means) if agreement.counts else None
    masked = [v for v in views if v.mask is not None]
    count = max(classes.values()) + 1
    weight, bias = _distinct_classes(count, generator)
    encodings = weight[labels].clone().requires_grad_(True)
    weight.requires_grad_(True)
    bias.requires_grad_(True)
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
        loss = identity_losses.pixel_cross_entropy(image, weight, bias, target)
        if neighbourhood is not None and step % section.regularise_every == 0:
            loss = loss + agreement.loss(encodings, weight, bias, neighbourhood, generator)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if progress is not None:
            progress(step + 1, float(loss.detach()))
    return encodings.detach(), weight.detach(), bias.detach()


class Agreement:
    """L_3d and L_major of some Gaussians with their neighbours, weighted.

    Args:
        config: The run's configuration.

    Attributes:
        counts: Whether either weighs anything.
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
        """What it adds to a step's loss; the classifier is asked of the drawn Gaussians and their neighbours alone.

        Args:
            encodings: Of all Gaussians. [N, 16]
            weight: Of the classifier. [C, 16]
            bias: Of the classifier. [C]
            neighbourhood: Of all Gaussians.
            generator: Source of the draws.
        """
        rows = torch.randint(len(encodings), (self._section.samples,), generator=generator)
        found = neighbourhood.nearest(rows, self._section.neighbours)
        both = torch.cat([rows[:, None], found], dim=1)
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


def joint(views: Sequence[TrainView], classes: dict[int, int], config: Config) -> JointIdentity | None:
    """Identities that are trained with the geometry, or None: not asked for, or no mask tells objects apart.

    Args:
        views: Training views.
        classes: Class of each object id.
        config: The run's configuration.
    """
    asked = config.identity.training in ("joint", "detached") and config.identity.iterations > 0
    if not asked or max(classes.values(), default=0) == 0 or all(view.mask is None for view in views):
        return None
    # A generator of its own: the other draws of a run are the same with identities and without.
    return JointIdentity(classes, config, torch.Generator().manual_seed(config.train.seed + 1))


class JointIdentity:
    """Encodings and classifier that are trained with the geometry.

    With ``identity.training`` "joint" (the paper) the trainer draws the encodings beside the colours, and the pixel
    loss reaches the geometry, too. With "detached" every few steps the encodings alone are drawn, and the geometry is
    what it would be without. The encodings are the Gaussians' parameter ``identities`` and grow and shrink with them.

    Args:
        classes: Class of each object id, 0 the background's.
        config: The run's configuration.
        generator: Source of all draws; nobody else's.

    Attributes:
        params: What the optimizer moves beside the encodings: ``classifier.weight`` [C, 16], ``classifier.bias`` [C].
        rates: Learning rates of ``identities`` and ``classifier``, constant over the run.
        with_geometry: Whether the trainer draws the encodings beside the colours.
    """

    def __init__(self, classes: dict[int, int], config: Config, generator: torch.Generator):
        self._classes = classes
        self._section = config.identity
        self._generator = generator
        self.with_geometry = config.identity.training == "joint"
        self._agreement = Agreement(config)
        count = max(classes.values()) + 1
        if self.with_geometry:
            spread_of_rows = 1 / math.sqrt(IDENTITY_DIM)
            draws = torch.rand(count, IDENTITY_DIM + 1, generator=generator)
            weight, bias = (spread_of_rows * (2 * draws - 1)).split([IDENTITY_DIM, 1], dim=1)
            bias = bias[:, 0]
        else:
            weight, bias = _distinct_classes(count, generator)
        self.params: dict[str, Tensor] = {}
        self._set_classifier(weight, bias)
        self.rates = {"identities": self._section.rate, "classifier": self._section.classifier_rate}
        self._neighbourhood: identity_losses.Neighbourhood | None = None
        self._found_at = 0
        # The tensors `means` and `motion_ids` then: new ones have other rows, or stand for Gaussians that were moved.
        self._found_for: tuple[Tensor, Tensor] | None = None

    def _set_classifier(self, weight: Tensor, bias: Tensor) -> None:
        named = {"classifier.weight": weight, "classifier.bias": bias}
        self.params = {n: t.detach().clone().contiguous().requires_grad_(True) for n, t in named.items()}

    def begin(self, gaussians: Gaussians) -> None:
        """Give the Gaussians their first encodings.

        "joint" draws them as Gaussian Grouping does, harmonics of random colours; "detached" gives each the row of the
        class that its motion group was made for (a group past the classes, a shadow, is background).
        """
        if self.with_geometry:
            draws = torch.rand(len(gaussians), IDENTITY_DIM, generator=self._generator)
            encodings = sh_color.rgb_to_dc(draws)
        else:
            weight = self.params["classifier.weight"].detach()
            ids = gaussians.motion_ids
            encodings = weight[torch.where(ids < len(weight), ids, 0)].clone()
        gaussians.add("identities", encodings)

    def channels(self, gaussians: Gaussians, colors: Tensor, background: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """What the trainer draws in one pass: colours and encodings [N, 3 + 16], and the background of both."""
        if background is not None:
            zeros = background.new_zeros((*background.shape[:-1], IDENTITY_DIM))
            background = torch.cat([background, zeros], dim=-1)
        return torch.cat([colors, gaussians.identities], dim=1), background

    def loss(
        self,
        gaussians: Gaussians,
        splats: Splats,
        view: TrainView,
        iteration: int,
        features: Tensor | None = None,
    ) -> Tensor | None:
        """What identities add to the loss of a step, or None.

        Args:
            gaussians: The Gaussians with their encodings.
            splats: Of the view; "detached" draws them, without gradient.
            view: The view; without a mask it has no pixel loss, and pixels of ids without a class do not count.
            iteration: The step.
            features: Blended encodings out of the pass that drew the colours; of "joint". [H, W, 16]
        """
        section = self._section
        weight, bias = self.params["classifier.weight"], self.params["classifier.bias"]
        terms = []
        if view.mask is not None and section.weight > 0:
            if not self.with_geometry and iteration % section.every == 0:
                features = _rasterize(splats, gaussians.identities, view)
            if features is not None:
                target = class_map(view, self._classes)
                terms.append(section.weight * identity_losses.pixel_cross_entropy(features, weight, bias, target))
        if iteration % section.regularise_every == 0 and self._agreement.counts:
            near = self._neighbours(gaussians, iteration)
            terms.append(self._agreement.loss(gaussians.identities, weight, bias, near, self._generator))
        return sum(terms[1:], terms[0]) if terms else None

    def _neighbours(self, gaussians: Gaussians, iteration: int) -> identity_losses.Neighbourhood:
        stale = not self._current(gaussians) or iteration - self._found_at >= NEIGHBOURS_EVERY
        if self._neighbourhood is None or stale:
            self._neighbourhood = identity_losses.Neighbourhood(gaussians.means)
            self._found_at, self._found_for = iteration, (gaussians.means, gaussians.motion_ids)
        return self._neighbourhood

    def _current(self, gaussians: Gaussians) -> bool:
        """Whether the neighbours were found for these Gaussians, row by row."""
        known = self._found_for
        return known is not None and known[0] is gaussians.means and known[1] is gaussians.motion_ids

    @torch.no_grad()
    def labels(self, gaussians: Gaussians) -> Tensor:
        """Class of each Gaussian: the classifier's answer to its encoding. [N] int64"""
        return (gaussians.identities @ self.params["classifier.weight"].T + self.params["classifier.bias"]).argmax(1)

    def outcome(self, gaussians: Gaussians) -> dict[str, Tensor]:
        """What a finished run hands to baking, by the names of the checkpoint."""
        named = {
            "identities": gaussians.identities,
            "classifier.weight": self.params["classifier.weight"],
            "classifier.bias": self.params["classifier.bias"],
        }
        return {name: tensor.detach().clone() for name, tensor in named.items()}

    def tensors(self, gaussians: Gaussians) -> dict[str, Tensor]:
        """Everything that the next step depends on beside the Gaussians, by name."""
        named = {f"identity.{name}": tensor.detach() for name, tensor in self.params.items()}
        named["identity.generator"] = self._generator.get_state()
        if self._neighbourhood is not None and self._current(gaussians):
            named["identity.points"] = self._neighbourhood.points
            named["identity.found_at"] = torch.tensor(self._found_at)
        return named

    def restore(self, tensors: dict[str, Tensor], gaussians: Gaussians) -> None:
        """Go on from `tensors`, with the Gaussians of the same state; before the optimizer is made."""
        self._set_classifier(tensors["identity.classifier.weight"], tensors["identity.classifier.bias"])
        self._generator.set_state(tensors["identity.generator"])
        self._neighbourhood, self._found_for = None, None
        if "identity.points" in tensors:
            self._neighbourhood = identity_losses.Neighbourhood(tensors["identity.points"])
            self._found_at = int(tensors["identity.found_at"])
            self._found_for = (gaussians.means, gaussians.motion_ids)


def class_map(view: TrainView, classes: dict[int, int]) -> Tensor:
    """Class of each pixel, -1 where the mask's id has none. [H, W] int64"""
    assert view.mask is not None
    table = np.full(max(int(view.mask.max(initial=0)), *classes) + 1, -1, np.int64)
    table[list(classes)] = list(classes.values())
    return torch.from_numpy(table[view.mask])


def _distinct_classes(count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A classifier, weight [C, 16] and bias [C], that names a pixel after the row that fills more than half of it."""
    directions = torch.randn(max(count, IDENTITY_DIM), IDENTITY_DIM, generator=generator)
    weight = torch.linalg.qr(directions).Q[:count].clone() if count <= IDENTITY_DIM else directions[:count]
    # The bias is half of what a solid pixel of an object answers: with less than half, or nothing, it is background.
    bias = torch.zeros(count)
    bias[0] = 2.0
    return 2 * weight / weight.norm(dim=1, keepdim=True), bias


def _rasterize(splats: Splats, channels: Tensor, view: TrainView) -> Tensor:
    return rasterize_splats(
        splats.means.detach(),
        splats.quats.detach(),
        splats.scales.detach(),
        splats.opacities.detach(),
        channels,
        view.camera,
    ).image
