"""Representation `field`: a deformation field for the observed time, and the TRD for extrapolation (5DGS, R5DGS).

Notation: N Gaussians, R of them moved by the networks, T the horizon of the deformation field. Network times are scene
times, shifted and scaled so that the observed ones lie in [0, 1]; if they already do and fill at least a quarter of it,
they are used unchanged.

Within the horizon, a share of the training steps (`field.trd_share`) draws a start t' = t -+ h; the field moves the
Gaussians to t', and the TRD from there to t in one step. Past the horizon, the TRD moves them from T to t. The TRD
starts at positions without gradient: its displacement trains the TRD, the position itself trains the field.

Source: TRACE's training scheme, with these additions: the restriction to movers, the fits to positions and to motion
    without images, and the cross-Gaussian twist loss.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...config.config import Config
from ...errors import CheckpointError, ConfigError
from ...model import deformation
from ...model.gaussians import Gaussians
from ...model.remembered import Remembered
from ...model.tracks import Tracks
from ...model.trd import SHAPES as TRD_SHAPES
from ...model.trd import TRD
from ...motion import rotations
from ...raster import shade
from ...scene import sampling, spherical_harmonics
from ...scene.cameras import Camera
from ..observed_motion import ObservedMotion
from . import field_fitting, field_to_groups, fused_posing, gating, rigidity, shading
from .field_motion import Clock, FieldMotion
from .representation import FIELD, Representation

log = logging.getLogger(__name__)

HORIZON = 14 / 15  # default horizon as a share of the observed span (0.70 of 0.75 in NVFi)


@dataclass(frozen=True)
class Path:
    """Path of the Gaussians to a time in a training step.

    Attributes:
        through_trd: True if the field moves them to ``start``, and the TRD from there to ``end``; False if the field
            moves them to ``end``.
        start: Scene time, a number or a tensor [].
        end: Scene time, a number or a tensor []; one TRD step from ``start`` if it is a tensor.
    """

    through_trd: bool
    start: float | Tensor
    end: float | Tensor

    @property
    def numbers(self) -> list[float]:
        """Start and end, for `from_buffer`."""
        return [float(self.start), float(self.end)]

    def from_buffer(self, buffer: Tensor) -> Path:
        """Return the path that reads `numbers` from a tensor."""
        return Path(self.through_trd, buffer[0], buffer[1])


@dataclass(frozen=True)
class MovedGaussians:
    """State of the moved Gaussians at a time.

    Attributes:
        rows: Rows of the Gaussians. [R]
        before: Canonical centres. [R, 3]
        offsets: Offsets from them. [R, 3]
        quats: Rotations applied after the canonical ones, unit wxyz. [R, 4]
        log_scales: Changes of the log scales. [R, 3]
    """

    rows: Tensor
    before: Tensor
    offsets: Tensor
    quats: Tensor
    log_scales: Tensor


class FieldRepresentation(Representation):
    """Gaussians moved one by one by `FieldMotion`, with shading that depends on their rotations.

    Args:
        tracks: Initial tracks by the masks, or trained tracks; the field may be fitted to them.
        first: Knot of the tracks at which the Gaussians are canonical.
        config: The run's configuration.
    """

    name, sorts_by_motion, penalizes_views = FIELD, True, True

    def __init__(self, tracks: Tracks, first: int, config: Config):
        self.times = tracks.times
        self.motion = _motion_of(self.times, config)
        self.light = torch.tensor([0.0, 0.0, 1.0], requires_grad=True)
        self._config = config
        self._tracks = tracks
        self._first = first
        self._last: MovedGaussians | None = None
        self._movers: Remembered[Tensor] = Remembered()
        self._iteration = config.field.warm_up  # a field that is not in training is past the warm-up

    def to(self, device: torch.device) -> FieldRepresentation:
        """See `Representation.to`."""
        self.motion.field.to(device)
        self.motion.trd.to(device)
        self.light = self.light.detach().to(device).requires_grad_(True)
        self._tracks = self._tracks.to(device)
        return self

    @property
    def params(self) -> dict[str, Tensor]:
        """Weights of both networks, and the light of the shading."""
        return {**_parameters(self.motion), "light": self.light}

    @property
    def _measured(self) -> bool:
        return gating.mover_rule(self._tracks.bodies, self._config) == "measured"

    def movers(self, gaussians: Gaussians) -> Tensor:
        """Return the rows that the networks move; none during the warm-up. [R] int64"""
        if self._iteration < self._config.field.warm_up:
            return gaussians.motion_ids.new_zeros(0)
        bodies = self._tracks.bodies
        return self._movers.of(
            gaussians.motion_ids, lambda groups: gating.movers(groups, bodies, self.times, self._config)
        )

    def path(self, t: float, draw: torch.Generator) -> Path:
        """Return a random path through field and TRD to a time of a training step."""
        motion, h = self.motion, self.motion.step
        if t > motion.horizon:
            return Path(True, motion.horizon, t)
        through, sign = torch.rand(2, generator=draw).tolist()
        if t < motion.start + h or through >= self._config.field.trd_share:
            return Path(False, t, t)
        return Path(True, min(max(t - h if sign < 0.5 else t + h, motion.start), motion.horizon), t)

    def graph_state(self) -> tuple[Tensor | None, ...]:
        """See `Representation.graph_state`."""
        return self.light, self._movers.value

    def graph_kind(self, path: Path, iteration: int) -> tuple | None:
        """See `Representation.graph_kind`."""
        one_step = abs(path.end - path.start) <= self.motion.step * (1 + 1e-9)
        calm = self._measured and iteration < gating.gate_step(self._config)
        warm = iteration < self._config.field.warm_up
        return None if warm or not one_step else (path.through_trd, calm, self._pulls_rigidly(iteration))

    def _pulls_rigidly(self, iteration: int) -> bool:
        """Return True if a step has L_rigid."""
        losses = self._config.losses
        started = iteration >= losses.rigid_start * self._config.train.iterations
        return self._config.field.variant == "r5dgs_extra" and losses.rigid > 0 and started

    def splats(self, gaussians: Gaussians, camera: Camera, t: float | Path) -> fused_posing.PosedSplats:
        """See `Representation.splats`."""
        params = gaussians.params
        moved = self.move(gaussians, t)
        self._last = moved
        rows = moved.rows
        means = params["means"].index_add(0, rows, moved.offsets)
        log_scales = params["log_scales"].index_add(0, rows, moved.log_scales)
        turned = rotations.multiply(moved.quats, rotations.normalize(params["quats"][rows]))
        quats = params["quats"].index_copy(0, rows, turned)
        if params["sh_rest"].shape[1] == 0:
            colors = spherical_harmonics.dc_to_rgb(params["sh"][:, 0])
        else:
            colors = shade.seen_colors(
                means.detach(), params["sh"], np.asarray(camera.center)[None], rest=params["sh_rest"]
            )
            # The harmonics of moved Gaussians are defined in their own frames.
            eye = torch.from_numpy(np.asarray(camera.center)).float().to(means.device, non_blocking=True)
            seen = means.detach()[rows] - eye
            seen = rotations.rotate(rotations.conjugate(moved.quats.detach()), seen / seen.norm(dim=1, keepdim=True))
            both = torch.cat([params["sh"][rows], params["sh_rest"][rows]], dim=1)
            colors = colors.index_copy(0, rows, spherical_harmonics.to_rgb(both, seen))
        if self._config.train.shading:
            seen_light = shading.seen_light(moved.quats, self.light)
            factor = shading.unclamped_factors(1, params["shading"][rows], seen_light, self.light)
            colors = shading.shade_rows(colors, rows, factor)
        return fused_posing.activate(means, quats, log_scales, params["opacity_logits"], colors)

    def begin(self, gaussians: Gaussians, draw: torch.Generator) -> None:
        """Fit field and TRD to the positions of the objects before the first image."""
        section = self._config.field
        self._iteration = 0
        gating.release_background(gaussians, self._tracks, self._config)
        if self._tracks.bodies < 2 or section.place_steps == 0:
            return
        self.fit(gaussians, self._tracks, section.place_steps, section.trd_steps, draw)

    def fit(
        self, gaussians: Gaussians, tracks: Tracks, field_steps: int, trd_steps: int, draw: torch.Generator
    ) -> None:
        """Fit field and TRD to the motion of tracks, without images; Gaussians of no body are fitted to rest."""
        rows = self.movers(gaussians)
        means, ids = gaussians.means.detach()[rows], gaussians.motion_ids[rows]
        groups = gating.rigid_groups(ids, tracks, 0)
        field_fitting.fit_field(self.motion, means, groups, tracks, self._first, field_steps, draw)
        groups = gating.rigid_groups(ids, tracks, field_fitting.ALONE)
        field_fitting.fit_trd(self.motion, means, groups, trd_steps, self._config.field.twist, draw)

    def move(self, gaussians: Gaussians, t: float | Path) -> MovedGaussians:
        """Return the moved Gaussians at a time, on the path of a training step or else that of `FieldMotion.at`."""
        rows, motion = self.movers(gaussians), self.motion
        before = gaussians.params["means"].detach()[rows]
        if not isinstance(t, Path):
            deltas = motion.at(before, t)
        elif t.through_trd:
            deltas = motion.through(before, t.start, t.end, motion.step)
        else:
            deltas = motion.deltas(before, t.end)
        return MovedGaussians(rows, before, deltas.offsets, deltas.quats, deltas.log_scales)

    def penalty(self, gaussians: Gaussians, iteration: int, labels: Callable[[], Tensor]) -> Tensor | None:
        """Return the sum of distance from rest (until the gate), stiffness, and L_rigid for variant ``r5dgs_extra``."""
        moved, self._last = self._last, None
        if moved is None or len(moved.rows) == 0:
            return None
        terms: list[Tensor] = []
        calm = self._config.field.calm
        if calm > 0 and self._measured and iteration < gating.gate_step(self._config):
            terms.append(calm * gating.distance_from_rest(moved.offsets, moved.quats, moved.log_scales))
        if self._tracks.bodies < 2:
            return terms[0] if terms else None
        groups = gating.rigid_groups(gaussians.motion_ids[moved.rows], self._tracks, 0)
        if self._config.field.stiffness > 0:
            after = moved.before + moved.offsets
            bent = rigidity.stiffness(moved.before, after, moved.quats, moved.log_scales, groups, self._tracks.groups)
            terms.append(self._config.field.stiffness * bent)
        losses = self._config.losses
        if self._pulls_rigidly(iteration):
            opacities = gaussians.opacity_logits.detach()[moved.rows].sigmoid()
            anchors = rigidity.anchors(moved.before, labels()[moved.rows], opacities, self._tracks.bodies)
            after = moved.before + moved.offsets
            terms.append(losses.rigid * rigidity.rigidity(moved.before, after, anchors, losses.rigid_form))
        return sum(terms[1:], terms[0]) if terms else None

    def after_step(self, gaussians: Gaussians, iteration: int, draw: torch.Generator) -> None:
        """Freeze Gaussians at rest once, if movers are measured, and periodically fit the TRD to the current motion."""
        section = self._config.field
        self._iteration = iteration
        if self._measured and iteration == gating.gate_step(self._config):
            rows = self.movers(gaussians)
            resting = gating.freeze_resting(gaussians, rows, self.motion, self.times, section.still)
            log.info("step %d: %d of %d Gaussians rest", iteration, len(resting), len(gaussians))
        every = round(section.trd_every * self._config.train.iterations)
        if section.trd_steps > 0 and every > 0 and iteration % every == 0:
            rows = self.movers(gaussians)
            means = gaussians.means.detach()[rows]
            groups = gating.rigid_groups(gaussians.motion_ids[rows], self._tracks, field_fitting.ALONE)
            field_fitting.fit_trd(self.motion, means, groups, section.trd_steps, section.twist, draw)

    def tensors(self) -> dict[str, Tensor]:
        """Return the weights by ``field.NAME`` and ``trd.NAME``, the times and the groups."""
        named = {n: p.detach() for n, p in self.params.items()}
        tracks = self._tracks
        named |= {"field.times": torch.from_numpy(self.times), "field.casters": tracks.casters}
        named["field.iteration"] = torch.tensor(self._iteration)
        return named | {"field.bodies": torch.tensor(tracks.bodies), "field.plane_normal": tracks.plane_normal}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state from `tensors`."""
        _load(self.motion, tensors)
        self.light = tensors["light"].clone().requires_grad_(True)
        self._iteration = int(tensors["field.iteration"])

    @staticmethod
    def group_classes(tensors: dict[str, Tensor]) -> np.ndarray:
        """See `Representation.group_classes`: the object of each body; background for shadows and for no body."""
        others = len(tensors["field.casters"]) + 1
        return np.concatenate([np.arange(int(tensors["field.bodies"])), np.zeros(others, np.int64)])

    @staticmethod
    def observed_motion(
        tensors: dict[str, Tensor], object_ids: np.ndarray, observed: np.ndarray, labels: np.ndarray, config: Config
    ) -> ObservedMotion:
        """See `Representation.observed_motion`: the groups are the classes and the shadows."""
        motion = _motion_of(tensors["field.times"].numpy(), config)
        _load(motion, tensors)
        gaussians = {n.removeprefix("gaussians."): p for n, p in tensors.items() if n.startswith("gaussians.")}
        return field_to_groups.observed_motion(
            motion,
            gaussians,
            gating.movers(
                gaussians["motion_ids"], int(tensors["field.bodies"]), tensors["field.times"].numpy(), config
            ),
            labels,
            object_ids,
            int(tensors["field.bodies"]) + len(tensors["field.casters"]),
            observed,
            tensors["field.times"].numpy(),
            tensors["field.casters"].tolist(),
            tensors["field.plane_normal"].numpy().astype(np.float64),
            tensors["light"].numpy().astype(np.float64),
            config.needs.regrouping,
        )


def _motion_of(times: np.ndarray, config: Config) -> FieldMotion:
    """Return untrained networks with the clock of the observed times."""
    section = config.field
    first, last = float(times[0]), float(times[-1])
    clock = Clock.of(times)
    if section.horizon and len(times) > 1 and not first < section.horizon <= last:
        raise ConfigError(
            f"field.horizon: expected a time after the first observed one, {first:g}, and up to the last, {last:g}; "
            f"got {section.horizon:g}"
        )
    generator = torch.Generator().manual_seed(config.train.seed)
    field_shape, trd_shape = deformation.SHAPES[section.size], TRD_SHAPES[section.size]
    if section.width:
        field_shape = replace(field_shape, width=section.width)
        trd_shape = replace(trd_shape, width=section.width)
    return FieldMotion(
        deformation.DeformationField(field_shape, generator),
        TRD(trd_shape, generator),
        clock,
        first,
        min(section.horizon or first + HORIZON * (last - first), last),
        section.step * clock.scale or 2 * sampling.spacing(times),
        section.chunk,
    )


def _parameters(motion: FieldMotion) -> dict[str, Tensor]:
    """Weights of both networks by ``field.NAME`` and ``trd.NAME``."""
    named: dict[str, Tensor] = {f"field.{n}": p for n, p in motion.field.named_parameters()}
    named.update({f"trd.{n}": p for n, p in motion.trd.named_parameters()})
    return named


@torch.no_grad()
def _load(motion: FieldMotion, tensors: dict[str, Tensor]) -> None:
    for name, parameter in _parameters(motion).items():
        if name not in tensors or tensors[name].shape != parameter.shape:
            raise CheckpointError(f"the checkpoint's '{name}': expected a tensor of shape {list(parameter.shape)}")
        parameter.copy_(tensors[name])
