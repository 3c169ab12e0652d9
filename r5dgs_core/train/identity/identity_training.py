"""Object identities of Gaussians: a vote of the masks, and identity encodings with their classifier.

The vote gives one label per Gaussian. The encodings, rendered and classified per pixel, follow the edges of the masks
more closely than labels can (Gaussian Grouping). Both are computed on finished, frozen geometry; encodings can also be
trained together with the geometry (`JointIdentity`).

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
NEIGHBOURS_EVERY = 300  # steps between searches for neighbours while the Gaussians' rows do not change


def votes(views: list[TrainView], pose: Callable[[TrainView], Splats], classes: dict[int, int], count: int) -> Tensor:
    """Return the contribution of each Gaussian to the mask pixels of each class.

    Args:
        views: Training views; at most `VOTE_VIEWS` with a mask are used, spread evenly.
        pose: Returns the splats of a view.
        classes: Class of each object id; other ids do not vote.
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
    """Return the class with most `votes` for each Gaussian, or its ``fallback`` [N] without votes. [N] int64"""
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
    """Return identities to train with the geometry; None if not configured or if no mask distinguishes objects.

    Args:
        views: Training views.
        classes: Class of each object id.
        config: The run's configuration.
    """
    asked = config.identity.training in ("joint", "detached") and config.identity.iterations > 0
    if not asked or max(classes.values(), default=0) == 0 or all(view.mask is None for view in views):
        return None
    # A separate generator, so that identities do not change the other random numbers of a run.
    return JointIdentity(classes, config, torch.Generator().manual_seed(config.train.seed + 1))


class JointIdentity:
    """Encodings and classifier that are trained together with the geometry.

    With ``identity.training`` "joint" (the paper), the trainer renders the encodings together with the colours, and the
    pixel loss also trains the geometry. With "detached", the encodings are rendered separately every few steps, and the
    geometry is the same as without them. The encodings are the Gaussians' parameter ``identities`` and take part in
    densification.

    Args:
        classes: Class of each object id, 0 for the background.
        config: The run's configuration.
        generator: Random generator, used for nothing else.

    Attributes:
        params: Parameters for the optimizer beside the encodings: ``classifier.weight`` [C, 16], ``classifier.bias``
            [C].
        rates: Learning rates of ``identities`` and ``classifier``, constant over the run.
        with_geometry: True if the trainer must render the encodings together with the colours.
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
        # `means` and `motion_ids` at that time; densification replaces these tensors.
        self._found_for: tuple[Tensor, Tensor] | None = None

    def _set_classifier(self, weight: Tensor, bias: Tensor) -> None:
        named = {"classifier.weight": weight, "classifier.bias": bias}
        self.params = {n: t.detach().clone().contiguous().requires_grad_(True) for n, t in named.items()}

    def begin(self, gaussians: Gaussians) -> None:
        """Initialise the encodings of the Gaussians.

        "joint" draws them as Gaussian Grouping does (harmonics of random colours). "detached" uses the classifier row
        of the class of each Gaussian's motion group, or of the background if the group has no class (shadows).
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
        """Return colours and encodings [N, 3 + 16] for one rasterizer pass, and the background of both."""
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
        """Return the term of the identities in a step's loss, or None.

        Args:
            gaussians: The Gaussians with their encodings.
            splats: Splats of the view; "detached" renders them without gradient.
            view: The view. Without a mask it has no pixel loss; pixels of ids without a class are ignored.
            iteration: The step.
            features: Blended encodings from the pass that rendered the colours ("joint"). [H, W, 16]
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
        """True if the neighbours were computed for these Gaussians, row by row."""
        known = self._found_for
        return known is not None and known[0] is gaussians.means and known[1] is gaussians.motion_ids

    @torch.no_grad()
    def labels(self, gaussians: Gaussians) -> Tensor:
        """Return the class of each Gaussian by the classifier. [N] int64"""
        return (gaussians.identities @ self.params["classifier.weight"].T + self.params["classifier.bias"]).argmax(1)

    def outcome(self, gaussians: Gaussians) -> dict[str, Tensor]:
        """Return the tensors of a finished run that baking needs, by their names in the checkpoint."""
        named = {
            "identities": gaussians.identities,
            "classifier.weight": self.params["classifier.weight"],
            "classifier.bias": self.params["classifier.bias"],
        }
        return {name: tensor.detach().clone() for name, tensor in named.items()}

    def tensors(self, gaussians: Gaussians) -> dict[str, Tensor]:
        """Return the state that the next step depends on, except for the Gaussians, by name."""
        named = {f"identity.{name}": tensor.detach() for name, tensor in self.params.items()}
        named["identity.generator"] = self._generator.get_state()
        if self._neighbourhood is not None and self._current(gaussians):
            named["identity.points"] = self._neighbourhood.points
            named["identity.found_at"] = torch.tensor(self._found_at)
        return named

    def restore(self, tensors: dict[str, Tensor], gaussians: Gaussians) -> None:
        """Restore the state from `tensors` and the Gaussians of that state. Call it before the optimizer is created."""
        self._set_classifier(tensors["identity.classifier.weight"], tensors["identity.classifier.bias"])
        self._generator.set_state(tensors["identity.generator"])
        self._neighbourhood, self._found_for = None, None
        if "identity.points" in tensors:
            self._neighbourhood = identity_losses.Neighbourhood(tensors["identity.points"])
            self._found_at = int(tensors["identity.found_at"])
            self._found_for = (gaussians.means, gaussians.motion_ids)


def class_map(view: TrainView, classes: dict[int, int]) -> Tensor:
    """Return the class of each pixel, -1 for ids without a class. [H, W] int64"""
    assert view.mask is not None
    table = np.full(max(int(view.mask.max(initial=0)), *classes) + 1, -1, np.int64)
    table[list(classes)] = list(classes.values())
    return torch.from_numpy(table[view.mask])


def _distinct_classes(count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return a classifier (weight [C, 16], bias [C]) that selects the class whose row fills over half of the pixel."""
    directions = torch.randn(max(count, IDENTITY_DIM), IDENTITY_DIM, generator=generator)
    weight = torch.linalg.qr(directions).Q[:count].clone() if count <= IDENTITY_DIM else directions[:count]
    # Half of the output for a fully covered pixel, so that pixels covered by less are background.
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
