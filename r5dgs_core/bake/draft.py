"""Data passed between the stages of baking: the context of a run, and a draft of its scene.

A `Stage` is a module with a function ``apply``, which leaves the arrays of its arguments unchanged.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from torch import Tensor

from ..config.config import Config
from ..config.sections.needs import NeedsSection
from ..data import dataset as datasets
from ..data.dataset import Dataset, View
from ..data.explained_pixels import ExplainedPixels
from ..scene.scene import MotionGroup, Scene
from ..train import checkpoint, checkpoint_content, run_folder, train_views
from ..train.normalization import Normalization
from ..train.observed_motion import ObservedMotion
from ..train.refinement import refined_dataset
from ..train.unexplained_views import Decision


@dataclass(frozen=True)
class Context:
    """A run and its data set.

    Attributes:
        run: The run folder.
        state: Its last checkpoint.
        dataset: The data set, with the corrections of the run's cameras; without names if the objects were
            discovered.
        norm: Training coordinates to world coordinates.
        given: The data set with the given cameras.
    """

    run: run_folder.Run
    state: checkpoint.Checkpoint
    dataset: Dataset
    norm: Normalization
    given: Dataset

    @property
    def config(self) -> Config:
        return self.run.config

    @property
    def wanted(self) -> NeedsSection:
        """User's overrides of the needs table."""
        return self.run.config.needs

    @property
    def tensors(self) -> dict[str, Tensor]:
        return self.state.tensors

    def explained(self, view: View, image: np.ndarray) -> np.ndarray | None:
        """Return the pixels of a training view that training has not left out; None for all. [H, W] bool

        Args:
            view: The view.
            image: Its image on the run's background, in the colours of its camera. [H, W, 3]

        Raises:
            DatasetError: An image is missing or cannot be read.
        """
        if self._explained is None:
            return None
        pixels, given = self._explained[0], self._explained[1][view.name]
        return pixels.of(given, image, datasets.load_mask(given)) if pixels.knows(given) else None

    @functools.cached_property
    def _explained(self) -> tuple[ExplainedPixels, dict[str, View]] | None:
        """Explained pixels and the given training views by name; None if training has left out nothing."""
        stored = self.tensors.get(checkpoint_content.UNEXPLAINED)
        if stored is None or not Decision.of(stored).on:
            return None
        pixels = ExplainedPixels(self.given, train_views.behind(self.given, self.config))
        return pixels, {view.name: view for view in self.given.train}

    def cameras(self, points: np.ndarray) -> dict[str, Any]:
        """Return the record of the refinement of the cameras; empty if none was tried.

        Args:
            points: Points of the scene, world. [N, 3]
        """
        found = refined_dataset.corrections(self.given, self.tensors, self.norm)
        return refined_dataset.record(self.given, self.tensors, found, points)

    @property
    def discovered(self) -> bool:
        """True if training found the objects; their ids are not those of the data set."""
        return is_discovered(self.state)


def is_discovered(state: checkpoint.Checkpoint) -> bool:
    """Return True if the objects of a checkpoint were found by training."""
    names = checkpoint_content.DISCOVERED_MASKS, checkpoint_content.DISCOVERED_LABELS
    return any(name in state.tensors for name in names)


@dataclass(frozen=True)
class Cloud:
    """Gaussians of a run in world coordinates, in the order of training.

    Attributes:
        means: [N, 3] float64
        quats: Unit wxyz. [N, 4] float64
        log_scales: [N, 3]
        opacity_logits: [N]
        sh: [N, K, 3] float64
        shading: [N, 3] float64
        rest: Factor of the colour at rest. [N] float64
        motion_ids: [N] int32
        object_ids: [N] int32
        identities: [N, 16] or None
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    shading: np.ndarray
    rest: np.ndarray
    motion_ids: np.ndarray
    object_ids: np.ndarray
    identities: np.ndarray | None


@dataclass(frozen=True)
class ObservedScene:
    """Content of a checkpoint without the features that the user disabled.

    Attributes:
        cloud: The Gaussians in the canonical state.
        motion: Observed motion of all Gaussians.
        light: Direction of the light, unit. [3]
    """

    cloud: Cloud
    motion: ObservedMotion
    light: np.ndarray


@dataclass(frozen=True)
class BoundScene:
    """Gaussians and motion groups in the bind state.

    Attributes:
        cloud: The Gaussians.
        groups: The scene's groups, with static models; rows of representatives are in the order of training.
        trained: Trained poses relative to the bind state. [G, S, 7]
        pivots: Pivots of these poses. [G, 3]
        played: The same poses without the parts that the user switched off. [G, S, 7]
    """

    cloud: Cloud
    groups: tuple[MotionGroup, ...]
    trained: np.ndarray
    pivots: np.ndarray
    played: np.ndarray


@dataclass(frozen=True)
class Need:
    """One row of the needs table.

    Attributes:
        name: Feature of the scene.
        value: Measured value.
        threshold: Minimum value at which the scene needs the feature.
        on: True if the scene gets the feature.
        reason: Meaning of the value.
        learned: True if the run has learned the feature.
    """

    name: str
    value: float
    threshold: float
    on: bool
    reason: str
    learned: bool = True

    def overridden(self, wanted: str) -> Need:
        """Return the row with the user's override "on" or "off" applied; "auto" keeps it."""
        if wanted == "auto":
            return self
        on = wanted == "on" and self.learned
        missing = wanted == "on" and not self.learned
        reason = f"set {wanted} by the user{', but not trained' if missing else ''}; {self.reason}"
        return replace(self, on=on, reason=reason)

    def decided_by_training(self, wanted: str) -> Need:
        """Return the row of a part of training with the user's override in its reason; baking cannot change it."""
        if wanted == "auto":
            return self
        kept = "" if wanted == ("on" if self.on else "off") else ", but training has decided otherwise"
        return replace(self, reason=f"set {wanted} by the user{kept}; {self.reason}")

    def row(self) -> dict[str, Any]:
        """Return the row as it is stored in a scene."""
        return {
            "name": self.name,
            "value": float(self.value),
            "threshold": float(self.threshold),
            "decision": "on" if self.on else "off",
            "reason": self.reason,
        }


@dataclass(frozen=True)
class Draft:
    """A scene that is being baked.

    Attributes:
        scene: The scene so far.
        observed: Content of the checkpoint.
        bound: The same in the bind state.
        order: Training row of each row of the scene. [N]
        bent: The row "residuals" of the needs table; `point_motion` measures it.
        trained: The scene before its motion was simplified.
        parts: Rows of the needs table for parts of single bodies' motion.
        slipped: First and last time of rotations that slipped, by group.
    """

    scene: Scene
    observed: ObservedScene
    bound: BoundScene
    order: np.ndarray
    bent: Need
    trained: Scene | None = None
    parts: tuple[dict[str, Any], ...] = ()
    slipped: Mapping[int, Sequence[tuple[float, float]]] = field(default_factory=dict)


class Stage(Protocol):
    """Interface of the stages that follow `assemble`."""

    def apply(self, draft: Draft, context: Context) -> Draft:
        """Return the draft with the part of the scene that this stage decides."""
        ...
