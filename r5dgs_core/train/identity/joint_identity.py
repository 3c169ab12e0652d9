"""Identity encodings that are trained together with the geometry.

Notation: N Gaussians, C classes: class 0 is the background, class k the k-th object.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ...config.config import Config
from ...model.gaussians import Gaussians
from ...scene import spherical_harmonics
from ...scene.scene import IDENTITY_DIM
from ..representations.fused_posing import PosedSplats
from ..train_views import TrainView
from . import identity_losses, identity_training
from .label_votes import class_map

NEIGHBOURS_EVERY = 300  # steps between searches for neighbours while the Gaussians' rows do not change


def joint(views: Sequence[TrainView], classes: dict[int, int], config: Config) -> JointIdentity | None:
    """Return identities to train with the geometry; None if not configured or if no mask distinguishes objects.

    Args:
        views: Training views.
        classes: Class of each object id.
        config: The run's configuration.
    """
    asked = config.identity.training in ("joint", "detached") and config.identity.iterations > 0
    if not asked or max(classes.values(), default=0) == 0 or not any(view.has_mask for view in views):
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
        self._agreement = identity_training.Agreement(config)
        count = max(classes.values()) + 1
        if self.with_geometry:
            spread_of_rows = 1 / math.sqrt(IDENTITY_DIM)
            draws = torch.rand(count, IDENTITY_DIM + 1, generator=generator)
            weight, bias = (spread_of_rows * (2 * draws - 1)).split([IDENTITY_DIM, 1], dim=1)
            bias = bias[:, 0]
        else:
            weight, bias = identity_training.distinct_classes(count, generator)
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

    def to(self, device: torch.device) -> None:
        """Move the classifier to a device."""
        self._set_classifier(*(tensor.detach().to(device) for tensor in self.params.values()))

    def begin(self, gaussians: Gaussians) -> None:
        """Initialise the encodings of the Gaussians.

        "joint" draws them as Gaussian Grouping does (harmonics of random colours). "detached" uses the classifier row
        of the class of each Gaussian's motion group, or of the background if the group has no class (shadows).
        """
        if self.with_geometry:
            draws = torch.rand(len(gaussians), IDENTITY_DIM, generator=self._generator)
            encodings = spherical_harmonics.rgb_to_dc(draws)
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
        splats: PosedSplats,
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
        if view.has_mask and section.weight > 0:
            if not self.with_geometry and iteration % section.every == 0:
                features = identity_training.rasterize(splats, gaussians.identities, view)
            if features is not None:
                target = class_map(view, self._classes, features.device)
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
        self._generator.set_state(tensors["identity.generator"].cpu())
        self._neighbourhood, self._found_for = None, None
        if "identity.points" in tensors:
            self._neighbourhood = identity_losses.Neighbourhood(tensors["identity.points"])
            self._found_at = int(tensors["identity.found_at"])
            self._found_for = (gaussians.means, gaussians.motion_ids)
