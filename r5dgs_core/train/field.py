"""The representation `field`: a deformation field for the observed time and the TRD for what follows (5DGS, R5DGS).

Notation: N Gaussians, R of them moved by the networks, T the horizon of the deformation field. Network times are scene
times moved and scaled so that the observed ones lie in [0, 1]; where they do already, they are used as they are.

Within the horizon a training step draws a start t' = t -+ h, lets the field bring the Gaussians there and the TRD carry
them to t in one step; past it, the TRD carries them from T to t. The TRD starts at positions without gradient: it is
taught by its displacement, the field by the position itself.

Source: TRACE's training scheme; movers alone, fits to places and to motion without images, and the cross-Gaussian twist
loss are ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..model import deformation, spherical_harmonics
from ..model.gaussians import Gaussians
from ..model.tracks import GroupPoses, Tracks
from ..model.trd import SHAPES as TRD_SHAPES
from ..model.trd import TRD, MotionState
from ..motion import dynamics, rotations
from ..raster import harmonics
from ..scene.cameras import Camera
from . import initialization, posing
from .config import Config

PLAYBACK_STEP = 1 / 60  # scene time per step of the TRD where a picture is wanted
HORIZON = 14 / 15  # of the last observed time, as 0.70 of 0.75


@dataclass(frozen=True)
class Clock:
    """From scene time to the networks' time: (t - origin) / scale."""

    origin: float
    scale: float

    @staticmethod
    def of(times: np.ndarray) -> Clock:
        """The clock of the observed times: the identity where they lie in [0, 1] and fill a quarter of it."""
        first, last = float(times[0]), float(times[-1])
        if first >= 0 and last <= 1 and last - first >= 0.25:
            return Clock(0.0, 1.0)
        return Clock(first, max(last - first, 1e-9))

    def __call__(self, t: float) -> float:
        return (t - self.origin) / self.scale


@dataclass(frozen=True)
class Moved:
    """Moved Gaussians at a time.

    Attributes:
        rows: Which ones. [R]
        before: Canonical centres. [R, 3]
        offsets: Added to them. [R, 3]
        quats: Rotations after the canonical ones, unit wxyz. [R, 4]
        log_scales: Added to the log scales. [R, 3]
    """

    rows: Tensor
    before: Tensor
    offsets: Tensor
    quats: Tensor
    log_scales: Tensor


class Motion:
    """Field and TRD with the clock that they share.

    Args:
        field: The deformation field.
        trd: The TRD network.
        clock: From scene time to theirs.
        horizon: Scene time T.
        step: Scene time h that the TRD bridges in training.
        chunk: Gaussians that pass the networks at once.
    """

    def __init__(
        self, field: deformation.DeformationField, trd: TRD, clock: Clock, horizon: float, step: float, chunk: int
    ):
        self.field = field
        self.trd = trd
        self.clock = clock
        self.horizon = horizon
        self.step = step
        self.chunk = chunk

    def deltas(self, means: Tensor, t: float) -> deformation.Deltas:
        """The field at a scene time, held past the horizon."""
        return self.field(means, self.clock(min(t, self.horizon)), self.chunk)

    def state(self, positions: Tensor, t: float) -> MotionState:
        """The TRD's answer for Gaussians that are somewhere at a scene time, per unit of network time."""
        return self.trd(positions, self.clock(t), self.chunk)

    def carry(self, positions: Tensor, state: MotionState, duration: float, step: float) -> tuple[Tensor, Tensor]:
        """Positions and rotations after a signed scene time, by TRACE's integrator. [R, 3], [R, 4]"""
        return dynamics.rk2(
            positions,
            state.equiv_velocity,
            state.angular_velocity,
            state.equiv_acceleration,
            state.angular_acceleration,
            duration / self.clock.scale,
            step / self.clock.scale,
        )

    def at(self, means: Tensor, t: float) -> deformation.Deltas:
        """Where Gaussians are at any time: by the field up to T, by the TRD from there on."""
        deltas = self.deltas(means, t)
        return deltas if t <= self.horizon else self.through(means, self.horizon, t, PLAYBACK_STEP)

    def through(self, means: Tensor, start: float, t: float, step: float) -> deformation.Deltas:
        """By the field to ``start``, by the TRD from there to ``t``. The TRD's start has no gradient."""
        deltas = self.deltas(means, start)
        begin = (means + deltas.offsets).detach()
        end, turns = self.carry(begin, self.state(begin, start), t - start, step)
        quats = rotations.multiply(turns, deltas.quats)
        return deformation.Deltas(deltas.offsets + (end - begin), quats, deltas.log_scales)


class FieldRepresentation:
    """Gaussians moved one by one by `Motion`.

    Args:
        start: What training starts from; its Gaussians are brought to the first time of training.
        config: The run's configuration.
    """

    name = "field"

    def __init__(self, start: initialization.Start, config: Config):
        section = config.field
        times = start.tracks.times
        last = float(times[-1])
        spacing = float(np.median(np.diff(times))) if len(times) > 1 else last or 1.0
        horizon = section.horizon or float(times[0]) + HORIZON * (last - float(times[0]))
        generator = torch.Generator().manual_seed(config.train.seed)
        self.motion = Motion(
            deformation.DeformationField(deformation.SHAPES[section.size], generator),
            TRD(TRD_SHAPES[section.size], generator),
            Clock.of(times),
            min(horizon, last),
            section.step or 2 * spacing,
            section.chunk,
        )
        self.times = times
        self._config = config
        self._tracks = start.tracks
        self._last: Moved | None = None
        bring_together(start.gaussians, start.tracks, start.first_time)

    @property
    def params(self) -> dict[str, Tensor]:
        """Weights of both networks."""
        named = {f"field.{n}": p for n, p in self.motion.field.named_parameters()}
        return named | {f"trd.{n}": p for n, p in self.motion.trd.named_parameters()}

    def movers(self, gaussians: Gaussians) -> Tensor:
        """Rows that the networks move. [R] int64"""
        if self._config.field.movers == "all" or self._tracks.bodies < 2:
            return torch.arange(len(gaussians))
        return (gaussians.motion_ids > 0).nonzero()[:, 0]

    def splats(
        self, gaussians: Gaussians, camera: Camera, t: float, draw: torch.Generator | None = None
    ) -> posing.Splats:
        """See `Representation.splats`."""
        params = gaussians.params
        moved = self.move(gaussians, t, draw)
        self._last = moved
        rows = moved.rows
        means = params["means"].index_add(0, rows, moved.offsets)
        log_scales = params["log_scales"].index_add(0, rows, moved.log_scales)
        turned = rotations.multiply(moved.quats, rotations.normalize(params["quats"][rows]))
        quats = params["quats"].index_copy(0, rows, turned)
        if params["sh_rest"].shape[1] == 0:
            colors = spherical_harmonics.dc_to_rgb(params["sh"][:, 0])
        else:
            colors = harmonics.seen_colors(
                means.detach(), params["sh"], np.asarray(camera.center)[None], rest=params["sh_rest"]
            )
        return posing.pose(
            means,
            quats,
            log_scales,
            params["opacity_logits"],
            colors,
            params["shading"],
            torch.zeros(3),
            torch.zeros(len(gaussians), dtype=torch.int64),
            _pinned(),
            torch.zeros(1, 3),
        )

    def move(self, gaussians: Gaussians, t: float, draw: torch.Generator | None = None) -> Moved:
        """Where the movers are at a time: in training by a drawn path through field and TRD, else by the rule."""
        rows = self.movers(gaussians)
        before = gaussians.params["means"].detach()[rows]
        deltas = self._train_path(before, t, draw) if draw is not None else self.motion.at(before, t)
        return Moved(rows, before, deltas.offsets, deltas.quats, deltas.log_scales)

    def _train_path(self, means: Tensor, t: float, draw: torch.Generator) -> deformation.Deltas:
        motion, h = self.motion, self.motion.step
        if t > motion.horizon:
            return motion.through(means, motion.horizon, t, h)
        through, sign = torch.rand(2, generator=draw).tolist()
        if t < h or through >= self._config.field.trd_share:
            return motion.deltas(means, t)
        start = min(max(t - h if sign < 0.5 else t + h, 0.0), motion.horizon)
        return motion.through(means, start, t, h)

    def penalty(self, gaussians: Gaussians, iteration: int) -> Tensor | None:
        """Nothing yet."""
        return None

    def enter(self, knot: int, towards: int, entered: tuple[int, int]) -> None:
        """A field reaches all times already."""

    def after_step(self, iteration: int) -> None:
        """Nothing to keep up."""

    def tensors(self) -> dict[str, Tensor]:
        """Weights by ``field.NAME`` and ``trd.NAME``, and the times."""
        return {n: p.detach() for n, p in self.params.items()} | {"field.times": torch.from_numpy(self.times)}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from `tensors`."""
        with torch.no_grad():
            for name, parameter in self.params.items():
                parameter.copy_(tensors[name])


def _pinned() -> GroupPoses:
    """The pose of one group that rests."""
    return GroupPoses(torch.tensor([[1.0, 0, 0, 0]]), torch.eye(3)[None], torch.zeros(1, 3))


def bring_together(gaussians: Gaussians, tracks: Tracks, knot: int) -> None:
    """Move each group of Gaussians, which start where they were seen best, to where it is at one knot, in place."""
    with torch.no_grad():
        poses = tracks.poses(float(tracks.times[knot]))
        ids, centers = gaussians.motion_ids, tracks.group_centers()
        means, quats = gaussians.params["means"], gaussians.params["quats"]
        arm = (means - centers[ids])[..., None]
        means.copy_((poses.rotmats[ids] @ arm)[..., 0] + centers[ids] + poses.displacements[ids])
        quats.copy_(rotations.multiply(poses.quats[ids], quats))
