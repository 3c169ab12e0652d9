"""Trainer of canonical Gaussians and their motion, from posed images with masks.

Each step poses the Gaussians at the time of one view, rasterizes and compares. Training starts at one time with good
visibility and adds the others outwards; densification adds Gaussians. `Trainer.state` contains everything that a step
depends on, so a resumed run gives the same numbers as an uninterrupted one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..config import training_needs
from ..config.config import Config
from ..data import memory
from ..data.dataset import Dataset
from ..errors import TrainingError
from ..model.gaussians import Gaussians
from ..model.remembered import Remembered
from ..raster import DRAFT, RasterStats, rasterize_splats
from ..scene.cameras import Camera
from ..scene.sampling import spacing
from . import (
    curriculum,
    devices,
    losses,
    normalization,
    step_graphs,
    train_views,
    trainer_state,
    unexplained_views,
    view_batch,
)
from . import optimizer as optimizers
from .checkpoint import Checkpoint
from .densification import densifier
from .densification import registry as densification
from .identity import joint_identity, packed_masks
from .initialization import free_space, run_start
from .refinement import rig
from .refinement.refinement import RefinedViews, Refinement
from .representations import fused_posing, registry, still
from .running_loss import CHECK_EVERY, RunningLoss, require_finite_state, require_finite_step
from .step_graphs import StepInputs
from .targets import Targets
from .workers import ALONE, Workers, on_this_machine

MAX_CAMERAS = 256  # maximum number of cameras in tests of visibility
FREEZE_EVERY = 100  # steps between updates of the frozen Gaussians


class Trainer:
    """State of one run: normalised data, parameters, optimizer and random generator.

    Args:
        dataset: The data set.
        config: The run's configuration.
        discovered_masks: Masks of the training views for the initialisation, if the data set has none.
        workers: Processes that take the same steps.
        state: Checkpoint that `restore` will be called with, whose choice of training data is kept.

    Raises:
        DatasetError: The training split is empty or cannot be read, or no Gaussian can be placed.
    """

    def __init__(
        self,
        dataset: Dataset,
        config: Config,
        discovered_masks: Sequence[np.ndarray] | None = None,
        workers: Workers = ALONE,
        state: Checkpoint | None = None,
    ):
        workers.check_batch(config.train.batch)
        self.workers = workers
        torch.set_num_threads(config.train.threads)
        self.dataset = dataset
        device = devices.select(config.train.device)
        self.config = config = training_needs.resolve(config)
        self.normalization = normalization.from_cameras([v.camera for v in dataset.train])
        self.behind = train_views.behind(dataset, config)
        self._memory = memory.for_images(config.data.memory, on_this_machine())
        views = train_views.load(dataset, self.normalization, self.behind, self._memory)
        self.given_views, self.unexplained = unexplained_views.decide(views, config, state)
        self.discovered_masks, shown = None, self.given_views
        if discovered_masks is not None:
            self.discovered_masks = packed_masks.pack(discovered_masks)
            shown = train_views.with_masks(self.given_views, discovered_masks)
        motion = registry.configured(config, at_rest=still.applies(self.given_views, config))
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
        self._free_space = start.free_space
        self.background = run_start.background(self.given_views, self.behind, start.sky, config)
        self.generator = torch.Generator().manual_seed(config.train.seed)
        classes = {int(object_id): row for row, object_id in enumerate(self.object_ids)}
        self.identity = joint_identity.joint(self.given_views, classes, config)
        if self.identity is not None:
            self.identity.begin(self.gaussians)
        self.rates = optimizers.LearningRates(config, {} if self.identity is None else self.identity.rates)
        self.iteration = 0
        self._loss = RunningLoss()
        view_times = np.array([train_views.nearest_knot(self.times, v.t) for v in self.given_views])
        self.curriculum = curriculum.Curriculum(config, view_times, len(self.times), self.first_time)
        self.distinct_cameras = [group[0].camera for group in train_views.by_camera(self.given_views, MAX_CAMERAS)]
        self.refinement = Refinement(rig.of(self.given_views), spacing(self.times), config.train.iterations)
        if start.colors is not None:
            self.refinement.begin_colors(start.colors)
        self.views = RefinedViews(self.given_views, self.refinement)  # corrects a camera on each access
        self._classes: Remembered[Tensor] = Remembered()  # of the motion groups of the Gaussians
        white = self.behind is not None and bool((self.behind == 1).all())
        cameras, count = [view.camera for view in self.given_views], len(self.gaussians)
        self._conditions = densifier.conditions(config, cameras, self.distinct_cameras, count, self.generator, white)
        self._begin_on(device)

    def _begin_on(self, device: torch.device) -> None:
        """Move all tensors to a device, and begin optimisation and densification there."""
        self.device = device
        self.targets = Targets(self.given_views, device, self._memory)
        self.gaussians = self.gaussians.to(device)
        self.motion = self.motion.to(device)
        self.background = self.background.to(device)
        if self.identity is not None:
            self.identity.to(device)
        self.frozen = torch.zeros(0, dtype=torch.bool, device=device)
        self.optimizer = self.make_optimizer()
        self.densifier = densification.make(self.config, self._conditions, len(self.gaussians), device)
        self._graphs = step_graphs.StepGraphs(self)

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
    def running_loss(self) -> float:
        """Smoothed loss, nan before the first step."""
        return self._loss.value

    @property
    def done(self) -> bool:
        """True if all steps are taken."""
        return self.iteration >= self.config.train.iterations

    def step(self) -> Tensor:
        """Take one step and return its loss, a scalar on the device of the run.

        Raises:
            TrainingError: The loss is not finite; the message names step, view and parameter. On a GPU, this is
                checked every `running_loss.CHECK_EVERY` steps.
        """
        if self.iteration == 0:
            self.motion.begin(self.gaussians, self.generator)
        motion = self.motion.before_step(self.gaussians, self.iteration, self.generator)
        if motion is not self.motion:
            self.motion = motion
            self.optimizer = self.make_optimizer()
        for knot, towards, entered in self.curriculum.grow(self.iteration):
            self.motion.enter(knot, towards, entered)
        drawn = [self.curriculum.draw(self.iteration, self.generator) for _ in range(self.config.train.batch)]
        self.targets.expect(self.curriculum.queue, masks=self.identity is not None)
        place = f"step {self.iteration}, view {', '.join(self.given_views[index].name for index in drawn)}"
        for group in self.optimizer.param_groups:
            group["lr"] = self.rates.at(group["name"], self.iteration)
        if self.iteration % FREEZE_EVERY == 0 or len(self.frozen) != len(self.gaussians):
            # The depth of background that only one camera sees is not determined.
            self.frozen = densifier.seen_by_one_camera(self.gaussians, self.distinct_cameras)
        # All processes draw the random numbers of all views.
        paths = [(index, self.motion.path(self.views[index].t, self.generator)) for index in drawn]
        batch = [StepInputs(k, self.views[k], path, self.targets.of(k)) for k, path in self.workers.share(paths)]
        if len(drawn) > 1:
            loss = view_batch.update(self, batch, place)
        elif self._graphs.take(batch[0]):
            loss = self._graphs.step(batch[0])
        else:
            loss = self.update(batch[0], RasterStats(), place)
        if self.device.type != devices.CPU and self.iteration % CHECK_EVERY == 0:
            require_finite_state(loss, self.params, place)
        self.iteration += 1
        self._loss.add(loss)
        self._maintain()
        return loss

    def compare(
        self, inputs: StepInputs, stats: RasterStats, place: str
    ) -> tuple[Tensor, Tensor | None, fused_posing.PosedSplats]:
        """Draw a view; return its loss, the loss of its identities or None, and its splats."""
        try:
            image, features, splats = self._draw_all(inputs, stats)
        except ValueError as error:
            optimizers.check_finite(self.params, 0.0, place)
            raise TrainingError(
                f"{place}: cannot be drawn: {error}; the last checkpoint is kept. "
                "Remedy: lower the learning rates (--set rates.NAME=VALUE) or look at that view's camera"
            ) from error
        self.refinement.watch(splats)
        image = self.refinement.shade(image, inputs.target, inputs.index)
        left_out = self.given_views[inputs.index].unexplained
        loss, identity = losses.photometric(image, inputs.target, self.config.losses.ssim, left_out), None
        if self.identity is not None:
            identity = self.identity.loss(self.gaussians, splats, inputs.view, self.iteration, features)
        return loss, identity, splats

    def penalties(self) -> list[Tensor | None]:
        """Return the terms of a step's loss that do not depend on a view; None if they do not count."""
        motion = None if self.motion.penalizes_views else self._motion_penalty()
        return [motion, self.densifier.penalty(self.gaussians)]

    def view_penalty(self) -> Tensor | None:
        """Return the term of the loss that depends on the motion of the view drawn last; None if it does not count."""
        return self._motion_penalty() if self.motion.penalizes_views else None

    def _motion_penalty(self) -> Tensor | None:
        return self.motion.penalty(self.gaussians, self.iteration, self.labels)

    def update(self, inputs: StepInputs, stats: RasterStats, place: str = "") -> Tensor:
        """Draw a view, update all parameters by the gradients, and return the loss; ``place`` is for messages."""
        loss, identity, splats = self.compare(inputs, stats, place)
        total = losses.total(loss, self.view_penalty(), *self.penalties(), identity)
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        loss = loss.detach()
        if self.device.type == devices.CPU:
            require_finite_step(loss, self.optimizer, self.params, place)
        view = inputs.view
        found = self.refinement.measure(inputs.index, view, splats, lambda t: self.splats(view.camera, t))
        self.refinement.apply(inputs.index, view.camera.width, found, self.iteration)
        self.move()
        self.densifier.observe(stats, view.camera)
        return loss

    def move(self) -> None:
        """Move the parameters against their gradients, except for what is not trained."""
        self._hide_harmonics()
        gradient = self.gaussians.params["means"].grad
        if gradient is not None:
            gradient.masked_fill_(self.frozen[:, None], 0.0)
        self.optimizer.step()

    def _draw_all(
        self, inputs: StepInputs, stats: RasterStats
    ) -> tuple[Tensor, Tensor | None, fused_posing.PosedSplats]:
        """Render a training view: image, blended encodings (None if rendered separately) and splats."""
        camera = inputs.view.camera
        splats = self.motion.splats(self.gaussians, camera, inputs.path)
        # The sky is that of the given camera, so that it is not computed again for each correction.
        background = self.background.image(self.given_views[inputs.index].camera, inputs.basis)
        colors = splats.colors
        together = self.identity is not None and self.identity.with_geometry
        if self.identity is not None and together:
            colors, background = self.identity.channels(self.gaussians, colors, background)
        image = _rasterized(splats, colors, camera, background, stats)
        return (image[..., :3].contiguous(), image[..., 3:], splats) if together else (image, None, splats)

    def render(
        self, camera: Camera, t: float, behind: Camera | None = None, stats: RasterStats | None = None
    ) -> Tensor:
        """Render a camera in normalised coordinates at a time, with the sky of another camera if given. [H, W, 3]"""
        splats = self.splats(camera, t)
        background = self.background.image(camera if behind is None else behind)
        return _rasterized(splats, splats.colors, camera, background, stats)

    def splats(self, camera: Camera, t: float) -> fused_posing.PosedSplats:
        """Return activated Gaussians in normalised coordinates at a time, as seen by a camera."""
        return self.motion.splats(self.gaussians, camera, t)

    def labels(self) -> Tensor:
        """Return the class of each Gaussian by the classifier if it is already trained, else by its group. [N]"""
        if self.identity is not None:
            return self.identity.labels(self.gaussians)
        return self._classes.of(self.gaussians.motion_ids, self._classes_of)

    def _classes_of(self, groups: Tensor) -> Tensor:
        classes = torch.from_numpy(self.motion.group_classes(self.motion.tensors()))
        return classes.to(self.device)[groups]

    def _hide_harmonics(self) -> None:
        """Keep untrained degrees of the harmonics at zero by zeroing their gradients, and so Adam's moments."""
        every, rest = self.config.train.sh_every, self.gaussians.params["sh_rest"]
        if every > 0 and rest.grad is not None:
            rest.grad[:, (self.iteration // every + 1) ** 2 - 1 :] = 0.0

    def _maintain(self) -> None:
        if self._free_space is not None and self.iteration % free_space.CLEAR_EVERY == 0:
            free_space.clear(self._free_space, self.gaussians)
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
        return trainer_state.of(self)

    def restore(self, state: Checkpoint) -> None:
        """Restore a `state` of a trainer with the same data set and configuration."""
        trainer_state.restore(self, state)
        self._loss = RunningLoss(state.running_loss)


def _rasterized(
    splats: fused_posing.PosedSplats,
    colors: Tensor,
    camera: Camera,
    background: Tensor | None,
    stats: RasterStats | None,
) -> Tensor:
    """Return the picture of posed Gaussians with these colours. [H, W, C]"""
    shapes = splats.means, splats.quats, splats.scales, splats.opacities
    return rasterize_splats(*shapes, colors, camera, background, settings=DRAFT, stats=stats).image
