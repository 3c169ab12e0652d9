"""Trainer of canonical Gaussians and their motion, from posed images with masks.

Each step poses the Gaussians at the time of one view, rasterizes and compares. Training starts at one time with good
visibility and adds the others outwards; densification adds Gaussians. `Trainer.state` contains everything that a step
depends on, so a resumed run gives the same numbers as an uninterrupted one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..config import training_needs
from ..config.config import Config
from ..data.dataset import Dataset
from ..errors import CheckpointError, TrainingError
from ..model.gaussians import Gaussians
from ..raster import RasterStats, rasterize_splats
from ..scene.cameras import Camera
from . import background as backgrounds
from . import checkpoint_content, curriculum, losses, normalization, train_views
from . import optimizer as optimizers
from .checkpoint import Checkpoint
from .densification import densifier
from .densification import registry as densification
from .identity import joint_identity, packed_masks
from .initialization import run_start
from .refinement import rig
from .refinement.refinement import RefinedViews, Refinement
from .representations import fused_posing, registry, still

TARGET_BYTES = 1 << 30  # maximum size of the cache of training images as floats
MAX_CAMERAS = 256  # maximum number of cameras in tests of visibility
FREEZE_EVERY = 100  # steps between updates of the frozen Gaussians


class Trainer:
    """State of one run: normalised data, parameters, optimizer and random generator.

    Args:
        dataset: The data set.
        config: The run's configuration.
        discovered_masks: Masks of the training views for the initialisation, if the data set has none.

    Raises:
        DatasetError: The training split is empty or cannot be read, or no Gaussian can be placed.
    """

    def __init__(
        self,
        dataset: Dataset,
        config: Config,
        discovered_masks: Sequence[np.ndarray] | None = None,
    ):
        torch.set_num_threads(config.train.threads)
        self.dataset = dataset
        self.config = config = training_needs.resolve(config)
        self.normalization = normalization.from_cameras([v.camera for v in dataset.train])
        self.behind = train_views.behind(dataset, config)
        self.views: Sequence[train_views.TrainView] = train_views.load(dataset, self.normalization, self.behind)
        self.discovered_masks = None if discovered_masks is None else packed_masks.pack(discovered_masks)
        shown = self.views if discovered_masks is None else train_views.with_masks(self.views, discovered_masks)
        motion = registry.configured(config, at_rest=still.applies(self.views, config))
        if not motion.moves:
            self.config = config = config.replace(**{"train.shading": False, "train.shadows": False})
        start = run_start.initial_state(
            shown, self.normalization, dataset, config, motion, discovered_masks is not None
        )
        self.gaussians: Gaussians = start.gaussians
        self.motion = registry.make(motion, start, config)
        self.times = start.tracks.times
        self.object_ids = start.object_ids
        self.places = start.places
        self.first_time = start.first_time
        self.background = run_start.background(self.views, self.behind, start.sky, config)
        self.generator = torch.Generator().manual_seed(config.train.seed)
        classes = {int(object_id): row for row, object_id in enumerate(self.object_ids)}
        self.identity = joint_identity.joint(self.views, classes, config)
        if self.identity is not None:
            self.identity.begin(self.gaussians)
        self.rates = optimizers.LearningRates(config, {} if self.identity is None else self.identity.rates)
        self.iteration = 0
        self.running_loss = math.nan
        view_times = np.array([train_views.nearest_knot(self.times, v.t) for v in self.views])
        self.curriculum = curriculum.Curriculum(config, view_times, len(self.times), self.first_time)
        self.distinct_cameras = [group[0].camera for group in train_views.by_camera(self.views, MAX_CAMERAS)]
        self.frozen = torch.zeros(0, dtype=torch.bool)
        self.optimizer = self.make_optimizer()
        self.densifier = densification.make(config, self._conditions(), len(self.gaussians))
        self._targets: dict[int, Tensor] = {}
        spacing = float(np.median(np.diff(self.times))) if len(self.times) > 1 else 1.0
        self.refinement = Refinement(rig.of(self.views), spacing, config.train.iterations)
        self.given_views, self.views = self.views, RefinedViews(self.views, self.refinement)

    def _conditions(self) -> densifier.Conditions:
        white = self.behind is not None and bool((self.behind == 1).all())
        cameras = [view.camera for view in self.views]
        return densifier.conditions(
            self.config, cameras, self.distinct_cameras, len(self.gaussians), self.generator, white
        )

    @property
    def params(self) -> dict[str, Tensor]:
        """All parameters by name, including those that are not trained."""
        return {**self.gaussians.params, **self._others()}

    def _others(self) -> dict[str, Tensor]:
        classifier = {} if self.identity is None else self.identity.params
        return {**self.motion.params, **self.background.params, **classifier}

    def make_optimizer(self) -> torch.optim.Adam:
        """Return an optimizer of all current parameters, without state."""
        return optimizers.make(self.gaussians.params, self._others(), self.rates)

    @property
    def done(self) -> bool:
        """True if all steps are taken."""
        return self.iteration >= self.config.train.iterations

    def step(self) -> float:
        """Take one step and return its loss.

        Raises:
            TrainingError: The loss is not finite; the message names step, view and parameter.
        """
        if self.iteration == 0:
            self.motion.begin(self.gaussians, self.generator)
        motion = self.motion.before_step(self.gaussians, self.iteration, self.generator)
        if motion is not self.motion:
            self.motion = motion
            self.optimizer = self.make_optimizer()
        for knot, towards, entered in self.curriculum.grow(self.iteration):
            self.motion.enter(knot, towards, entered)
        index = self.curriculum.draw(self.iteration, self.generator)
        view = self.views[index]
        place = f"step {self.iteration}, view {view.name}"
        for group in self.optimizer.param_groups:
            group["lr"] = self.rates.at(group["name"], self.iteration)
        stats = RasterStats()
        try:
            image, features, splats = self._draw_all(view, self.given_views[index].camera, stats)
        except ValueError as error:
            optimizers.check_finite(self.params, 0.0, place)
            raise TrainingError(
                f"{place}: cannot be drawn: {error}; the last checkpoint is kept. "
                "Remedy: lower the learning rates (--set rates.NAME=VALUE) or look at that view's camera"
            ) from error
        self.refinement.watch(splats)
        target = self._target(index)
        image = self.refinement.shade(image, target, index)
        loss = losses.photometric(image, target, self.config.losses.ssim)
        penalties = [self.motion.penalty(self.gaussians, self.iteration, self._labels)]
        penalties.append(self.densifier.penalty(self.gaussians))
        if self.identity is not None:
            penalties.append(self.identity.loss(self.gaussians, splats, view, self.iteration, features))
        total = loss
        for penalty in penalties:
            total = total if penalty is None else total + penalty
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        value = float(loss.detach())
        if not (math.isfinite(value) and optimizers.has_finite_gradients(self.optimizer)):
            optimizers.check_finite(self.params, value, place)
        self.refinement.update(index, view, splats, self.iteration, lambda t: self.splats(view.camera, t))
        self._hide_harmonics()
        self._freeze_single_view_centres()
        self.optimizer.step()
        self.densifier.observe(stats, view.camera)
        self.iteration += 1
        self.running_loss = value if math.isnan(self.running_loss) else 0.98 * self.running_loss + 0.02 * value
        self._maintain()
        return value

    def _freeze_single_view_centres(self) -> None:
        """Freeze the centres of background Gaussians that only one camera sees, as their depth is not determined."""
        if self.iteration % FREEZE_EVERY == 0 or len(self.frozen) != len(self.gaussians):
            self.frozen = densifier.seen_by_one_camera(self.gaussians, self.distinct_cameras)
        gradient = self.gaussians.params["means"].grad
        if gradient is not None:
            gradient[self.frozen] = 0.0

    def _draw_all(
        self, view: train_views.TrainView, behind: Camera, stats: RasterStats
    ) -> tuple[Tensor, Tensor | None, fused_posing.PosedSplats]:
        """Render a training view: image, blended encodings (None if rendered separately) and splats.

        The sky is that of the camera ``behind``, so that it need not be computed again for each correction.
        """
        splats = self.splats(view.camera, view.t, self.generator)
        colors, background = splats.colors, self.background.image(behind)
        together = self.identity is not None and self.identity.with_geometry
        if self.identity is not None and together:
            colors, background = self.identity.channels(self.gaussians, colors, background)
        image = rasterize_splats(
            splats.means,
            splats.quats,
            splats.scales,
            splats.opacities,
            colors,
            view.camera,
            background,
            stats=stats,
        ).image
        return (image[..., :3].contiguous(), image[..., 3:], splats) if together else (image, None, splats)

    def render(self, camera: Camera, t: float, behind: Camera | None = None) -> Tensor:
        """Render a camera in normalised coordinates at a time, with the sky of another camera if given. [H, W, 3]"""
        splats = self.splats(camera, t)
        return rasterize_splats(
            splats.means,
            splats.quats,
            splats.scales,
            splats.opacities,
            splats.colors,
            camera,
            self.background.image(camera if behind is None else behind),
        ).image

    def splats(self, camera: Camera, t: float, draw: torch.Generator | None = None) -> fused_posing.PosedSplats:
        """Return activated Gaussians in normalised coordinates at a time, as seen by a camera."""
        return self.motion.splats(self.gaussians, camera, t, draw)

    def _labels(self) -> Tensor:
        """Class of each Gaussian by the classifier if it is already trained, else by its motion group. [N]"""
        if self.identity is not None:
            return self.identity.labels(self.gaussians)
        return torch.from_numpy(self.motion.group_classes(self.motion.tensors()))[self.gaussians.motion_ids]

    def _target(self, index: int) -> Tensor:
        """Return a view's image in [0, 1]. Cached if all views fit into `TARGET_BYTES`, else converted on each call."""
        if index in self._targets:
            return self._targets[index]
        target = torch.from_numpy(self.views[index].image).float() / 255
        if sum(v.image.size for v in self.views) * 4 <= TARGET_BYTES:
            self._targets[index] = target
        return target

    def _hide_harmonics(self) -> None:
        """Keep untrained degrees of the harmonics at zero by zeroing their gradients, and so Adam's moments."""
        every, rest = self.config.train.sh_every, self.gaussians.params["sh_rest"]
        if every > 0 and rest.grad is not None:
            rest.grad[:, (self.iteration // every + 1) ** 2 - 1 :] = 0.0

    def _maintain(self) -> None:
        self.motion.after_step(self.gaussians, self.iteration, self.generator)
        self.densifier.after_step(
            self.gaussians, self.optimizer, self.iteration, self.rates.at("means", self.iteration)
        )
        if len(self.gaussians) == 0:
            raise TrainingError(
                f"step {self.iteration}: every Gaussian has become too faint or too wide and was removed; the last "
                "checkpoint is kept. Remedy: lower the learning rates (rates.*) or densify.prune_opacity"
            )

    def state(self) -> Checkpoint:
        """Return everything that the next step depends on."""
        tensors: dict[str, Tensor] = {f"gaussians.{n}": p.detach() for n, p in self.gaussians.params.items()}
        tensors["gaussians.motion_ids"] = self.gaussians.motion_ids
        tensors |= self.motion.tensors()
        if self.identity is not None:
            tensors |= self.identity.tensors(self.gaussians)
        if self.discovered_masks is not None:
            tensors[checkpoint_content.DISCOVERED_MASKS] = self.discovered_masks
        tensors["background"] = self.background.params["background"].detach()
        tensors["object_ids"] = torch.from_numpy(np.asarray(self.object_ids, np.int64))
        tensors["generator"] = self.generator.get_state()
        if len(self.frozen) == len(self.gaussians):
            tensors[checkpoint_content.FROZEN] = self.frozen
        tensors |= self.densifier.tensors() | self.refinement.tensors()
        tensors |= optimizers.tensors(self.optimizer)
        x, y, z = (float(v) for v in self.dataset.origin + self.normalization.origin)
        return Checkpoint(
            tensors={n: t.detach().clone() for n, t in tensors.items()},
            representation=self.motion.name,
            iteration=self.iteration,
            entered=self.curriculum.entered,
            first_time=self.first_time,
            queue=tuple(self.curriculum.queue),
            running_loss=self.running_loss,
            origin=(x, y, z),
            scale=float(self.normalization.scale),
            observed=torch.from_numpy(self.places.shown.copy()),
        )

    def restore(self, state: Checkpoint) -> None:
        """Restore a `state` of a trainer with the same data set and configuration."""
        tensors = {name: tensor.clone() for name, tensor in state.tensors.items()}  # training modifies them in place
        g = {n.removeprefix("gaussians."): t for n, t in tensors.items() if n.startswith("gaussians.")}
        self.gaussians = Gaussians({n: t for n, t in g.items() if n != "motion_ids"}, g["motion_ids"])
        self.motion = self.motion.restored(state.representation, tensors)
        if self.identity is not None:
            self.identity.restore(tensors, self.gaussians)
        self.background = backgrounds.Background(tensors["background"], self.background.learned)
        self.object_ids = tensors["object_ids"].numpy()
        try:
            self.generator.set_state(tensors["generator"])
        except (RuntimeError, TypeError) as error:
            raise CheckpointError(
                f"the checkpoint's 'generator' is not a state of torch's generator: {error}"
            ) from error
        if any(len(t) != len(self.gaussians) for n, t in tensors.items() if n.startswith("gradients.")):
            raise CheckpointError(f"the checkpoint's 'gradients.*': expected {len(self.gaussians)} rows each")
        self.densifier.restore(tensors)
        self.refinement.restore(tensors)
        self.frozen = tensors.get(checkpoint_content.FROZEN, torch.zeros(0, dtype=torch.bool))
        self.optimizer = self.make_optimizer()
        optimizers.restore(self.optimizer, tensors)
        self.iteration = state.iteration
        self.curriculum.entered = state.entered
        self.first_time = state.first_time
        self.curriculum.queue = list(state.queue)
        self.running_loss = state.running_loss
