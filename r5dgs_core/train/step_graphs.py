"""CUDA graphs of training steps.

A step consists of about a thousand short kernels, and launching them takes several times as long as running them. A
graph launches all of them at once. What differs between steps is copied into buffers that the graph reads: camera,
background, target, times and learning rates. One graph is captured for each kind of step (`Representation.graph_kind`),
and again when the number of Gaussians changes.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..raster import RasterStats, cuda_projection
from ..scene import sampling
from .train_views import TrainView

log = logging.getLogger(__name__)

BEFORE = 20  # steps without graphs at the start of a run
ROOM = 2.0  # capacity for pairs of Gaussian and tile, relative to the largest number of some views
CAMERAS = 4  # number of these views
CHECK_EVERY = 50  # steps between comparisons of the number of pairs with the capacity


@dataclass(frozen=True)
class StepInputs:
    """Inputs of a training step besides the state.

    Attributes:
        index: Index of the view.
        view: The view, with its corrected camera and time.
        path: Result of `Representation.path`.
        target: Its image in [0, 1]. [H, W, 3]
        basis: Harmonics of its background; None to look them up. [H W, Kb]
    """

    index: int
    view: TrainView
    path: Any
    target: Tensor
    basis: Tensor | None = None


class CapturedWork:
    """Work on the current device as a CUDA graph.

    Args:
        work: The work, without copies from or to the host. It is captured, but not executed.
        pool: Memory pool that all graphs of a run share.
    """

    def __init__(self, work: Callable[[], object], pool: Any):
        self._graph = torch.cuda.CUDAGraph()
        stream = _capture_stream(torch.cuda.current_device())
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            self._graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                work()
            finally:
                self._graph.capture_end()
        torch.cuda.current_stream().wait_stream(stream)

    def replay(self) -> None:
        """Do the work."""
        self._graph.replay()


@functools.cache
def _capture_stream(device: int) -> torch.cuda.Stream:
    """Return the stream on which graphs are captured; memory of the pool is reused within one stream only."""
    return torch.cuda.Stream(device)


class StepGraphs:
    """Graphs of the steps of a trainer, used if its configuration permits.

    Args:
        trainer: The `trainer.Trainer`, which imports this module.
    """

    def __init__(self, trainer: Any):
        config = trainer.config
        self._trainer = trainer
        self._enabled = (
            trainer.device.type == "cuda"
            and config.train.graphs
            and trainer.gaussians.params["sh_rest"].shape[1] == 0
            and trainer.identity is None
            and all(view.load_unexplained is None for view in trainer.given_views)
            and len({(view.camera.width, view.camera.height) for view in trainer.views}) == 1
        )
        self._graphs: dict[tuple, CapturedWork] = {}
        self._pool: Any = None
        self._state: tuple[Tensor | None, ...] = ()  # the graphs are valid as long as these tensors are not replaced
        self._waited = self._capacity = 0
        self._pairs = torch.zeros((), dtype=torch.int64)

    def take(self, inputs: StepInputs) -> bool:
        """Return True if `step` can take the next step; call it before each step."""
        trainer = self._trainer
        if not self._enabled or trainer.refinement.active:  # corrections are computed on the host
            return False
        gaussians, statistics = trainer.gaussians, trainer.densifier.tensors().values()
        state = (gaussians.params["means"], gaussians.motion_ids, *trainer.motion.graph_state(), *statistics)
        changed = len(self._state) != len(state) or any(a is not b for a, b in zip(state, self._state, strict=True))
        if not changed and self._capacity and trainer.iteration % CHECK_EVERY == 0:
            changed = int(self._pairs) > self._capacity  # some Gaussians are missing in some tiles
        if changed:
            self._graphs, self._capacity, self._state = {}, 0, state
        self._waited += 1
        usable = trainer.motion.graph_kind(inputs.path, trainer.iteration) is not None
        return usable and not changed and self._waited > BEFORE

    def step(self, inputs: StepInputs) -> Tensor:
        """Take a step and return its loss."""
        if not self._capacity:
            self._make_buffers(inputs)
        kind = self._trainer.motion.graph_kind(inputs.path, self._trainer.iteration)
        assert kind is not None
        self._write(inputs)
        if kind not in self._graphs:
            try:
                self._graphs[kind] = CapturedWork(lambda: self._work(inputs.path), self._pool)
            except RuntimeError as error:
                log.warning("training goes on without CUDA graphs, which is slower: %s", error)
                self._enabled = False
                return self._trainer.update(inputs, RasterStats())
        self._graphs[kind].replay()
        return self._loss

    def _make_buffers(self, inputs: StepInputs) -> None:
        """Create the buffers, with room for the pairs of all views."""
        trainer = self._trainer
        device, groups = trainer.device, trainer.optimizer.param_groups
        self._pairs = torch.zeros((), dtype=torch.int64, device=device)
        if self._pool is None:
            self._pool = torch.cuda.graph_pool_handle()
            # A graph that is never dropped keeps the memory of dropped ones in the pool; allocating it takes seconds.
            self._keeper = CapturedWork(lambda: self._pairs.zero_(), self._pool)
        trainer.labels()  # looks them up before a graph reads them
        for group in groups:
            group["capturable"] = True
        self._numbers = torch.zeros(len(inputs.path.numbers), dtype=torch.float64, device=device)
        self._rates = torch.zeros(len(groups), device=device)
        self._loss = torch.zeros((), device=device)
        view, lens = cuda_projection.matrices(inputs.view.camera, device)
        self._view, self._lens = view.clone(), lens.clone()
        self._target = inputs.target.clone()
        self._basis = trainer.background.basis(inputs.view.camera).clone() if trainer.background.learned else None
        self._frozen = trainer.frozen
        self._capacity = max(1, int(ROOM * self._most_pairs()))

    @torch.no_grad()
    def _most_pairs(self) -> int:
        """Return the largest number of pairs of Gaussian and tile in the views of the distinct cameras."""
        trainer, most = self._trainer, torch.zeros((), dtype=torch.int64, device=self._trainer.device)
        for camera in sampling.spread(trainer.distinct_cameras, CAMERAS):
            stats = RasterStats(capacity=1)
            trainer.render(camera, float(trainer.times[-1]), stats=stats)
            assert stats.pairs is not None  # as a capacity was given
            most = torch.maximum(most, stats.pairs)
        return int(most)

    def _write(self, inputs: StepInputs) -> None:
        """Write the inputs of a step into the buffers."""
        trainer = self._trainer
        view, lens = cuda_projection.matrices(inputs.view.camera, trainer.device)
        self._view.copy_(view)
        self._lens.copy_(lens)
        self._target.copy_(inputs.target)
        if self._basis is not None:
            self._basis.copy_(trainer.background.basis(inputs.view.camera))
        if trainer.frozen is not self._frozen:
            self._frozen.copy_(trainer.frozen)
            trainer.frozen = self._frozen
        self._numbers.copy_(torch.tensor(inputs.path.numbers, dtype=torch.float64), non_blocking=True)
        rates = torch.tensor([group["lr"] for group in trainer.optimizer.param_groups])  # set by the trainer's step
        self._rates.copy_(rates, non_blocking=True)

    def _work(self, like: Any) -> None:
        """Take a step from the buffers, with a path of the kind of another one."""
        trainer, some = self._trainer, self._trainer.views[0]
        shape = some.camera
        camera = cuda_projection.PlacedCamera(
            shape.width, shape.height, shape.intrinsics, shape.T_cam_world, view=self._view, lens=self._lens
        )
        view = dataclasses.replace(some, camera=camera)
        inputs = StepInputs(0, view, like.from_buffer(self._numbers), self._target, self._basis)
        for group, rate in zip(trainer.optimizer.param_groups, self._rates, strict=True):
            group["lr"] = rate
        stats = RasterStats(capacity=self._capacity)
        self._loss.copy_(trainer.update(inputs, stats))
        assert stats.pairs is not None
        # The memory of the gradients belongs to the graph, and other graphs overwrite it.
        trainer.optimizer.zero_grad(set_to_none=True)
        torch.maximum(self._pairs, stats.pairs, out=self._pairs)
