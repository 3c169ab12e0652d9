"""Representation `tracks`: one SE(3) track per object, with shading and shadows that follow the motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...config.config import Config
from ...model import track_state
from ...model.gaussians import Gaussians
from ...model.tracks import Tracks
from ...motion import rotations
from ...raster import shade
from ...scene import spherical_harmonics
from ...scene.cameras import Camera
from ..initialization import initialize
from ..observed_motion import GroupTrack, ObservedMotion
from ..train_views import nearest_knot
from . import fused_posing, residual
from .representation import FIELD, TRACKS, Representation

ROUGHNESS_EVERY = 4  # steps between evaluations of the roughness; its weight is multiplied by this
REBASE_EVERY = 100  # steps
DRIFT = 0.15  # distance of a track from the path of the masks above which it has drifted, radii of the object
ABSENT = "tracks.absent"  # only present if an object is absent at some time
MIN_KNOTS = 3  # minimum number of knots that determine the usual offset of a track from the path


@dataclass(frozen=True)
class AtKnot:
    """An observed time in a training step.

    Attributes:
        knot: The knot, a number or an int64 tensor [1].
        there: 1 for each group that is in the scene then, 0 for others; None if all always are. [G] array or tensor
    """

    knot: int | Tensor
    there: np.ndarray | Tensor | None

    @property
    def numbers(self) -> list[float]:
        """Knot and presence of the groups, for `from_buffer`."""
        return [float(self.knot), *([] if self.there is None else map(float, self.there))]

    def from_buffer(self, buffer: Tensor) -> AtKnot:
        """Return the path that reads `numbers` from a tensor."""
        return AtKnot(buffer[:1].long(), None if self.there is None else buffer[1:].float())


class TracksRepresentation(Representation):
    """One SE(3) track per object, with shading that turns in fixed light and shadows that follow their caster.

    Args:
        start: Initial state of training: tracks, positions of the objects for knots that enter, and evidence.
        config: The run's configuration.
    """

    name, takes_residuals = TRACKS, True

    def __init__(self, start: initialize.InitialState, config: Config):
        self.tracks = first_tracks(start.tracks)
        self.light = torch.from_numpy(start.tracks.light).float().requires_grad_(True)
        self._places = start.places
        self._absent = start.evidence.absent
        self._stiffness = tuple(
            torch.from_numpy(a).float() for a in (start.evidence.shift_stiffness, start.evidence.turn_stiffness)
        )
        self._owners, self._casters = self.tracks.owners.numpy(), self.tracks.casters.numpy()
        self._first = start.first_time
        self._entered = (start.first_time, start.first_time)
        self._gains: Tensor | None = None  # gain of the residuals per body, dB, after the trial
        self._config = config

    def to(self, device: torch.device) -> TracksRepresentation:
        """See `Representation.to`."""
        self.tracks = self.tracks.to(device)
        self.light = self.light.detach().to(device).requires_grad_(True)
        self._stiffness = tuple(tensor.to(device) for tensor in self._stiffness)
        return self

    @property
    def params(self) -> dict[str, Tensor]:
        """Tracks, light direction, and residuals of non-rigid bodies if there are any."""
        residuals = {} if self.residuals is None else {"residual": self.residuals.values}
        return {**self.tracks.params, "light": self.light, **residuals}

    def before_step(self, gaussians: Gaussians, iteration: int, draw: torch.Generator) -> Representation:
        """Return a field that continues from the tracks after ``field.tracks_share`` of a run that trains a field."""
        config = self._config
        share = config.field.tracks_share * config.train.iterations
        if config.train.representation != FIELD or iteration < share:
            return self
        from . import field_handover

        return field_handover.from_tracks(self.tracks, self.light, gaussians, self._first, config, draw)

    def path(self, t: float, draw: torch.Generator) -> float | AtKnot:
        """Return the knot at an observed time."""
        weights = self.tracks.knot_weights(t)
        if len(weights) > 1:
            return t
        return AtKnot(next(iter(weights)), self._there(t) if self._absent.any() else None)

    def graph_state(self) -> tuple[Tensor | None, ...]:
        """See `Representation.graph_state`."""
        params = self.tracks.params
        residuals = None if self.residuals is None else self.residuals.values
        return params["translations"], self.tracks.base_quats, self.light, residuals

    def graph_kind(self, path: float | AtKnot, iteration: int) -> tuple | None:
        """See `Representation.graph_kind`."""
        all_entered = self._entered == (0, len(self.tracks.times) - 1)
        return (iteration % ROUGHNESS_EVERY == 0,) if all_entered and isinstance(path, AtKnot) else None

    def _there(self, t: float) -> np.ndarray:
        """Return 1 for each group that is in the scene at a time, 0 for others. [G] float32"""
        gone = self._absent[self._owners[1:] - 1, nearest_knot(self.tracks.times, t)]
        there = np.concatenate([[1.0], ~gone]).astype(np.float32)
        return np.concatenate([there, there[self._casters]])

    def splats(self, gaussians: Gaussians, camera: Camera, t: float | AtKnot) -> fused_posing.PosedSplats:
        """See `Representation.splats`."""
        if isinstance(t, AtKnot):
            weights, there = t.knot if isinstance(t.knot, Tensor) else {t.knot: 1.0}, t.there
        else:
            weights, there = self.tracks.knot_weights(t), self._there(t)
        poses = self.tracks.poses_of(weights)
        centers = self.tracks.group_centers()
        params = gaussians.params
        if params["sh_rest"].shape[1] == 0:
            colors = spherical_harmonics.dc_to_rgb(params["sh"][:, 0])
        else:
            # The harmonics are defined in each group's own frame, so the camera is transformed into it.
            with torch.no_grad():
                eye = torch.from_numpy(camera.center).float().to(centers.device, non_blocking=True)
                arm = centers + poses.displacements - eye
                eyes = centers - (poses.rotmats.transpose(1, 2) @ arm[..., None])[..., 0]
            colors = shade.seen_colors(
                params["means"].detach(),
                params["sh"],
                eyes,
                rest=params["sh_rest"],
                pose_ids=gaussians.motion_ids,
            )
        means, quats, log_scales = params["means"], params["quats"], params["log_scales"]
        shading = params["shading"]
        if self.residuals is not None:
            opacities = torch.sigmoid(params["opacity_logits"])
            change = self.residuals.change(means, quats, opacities, gaussians.motion_ids, weights)
            means = means.index_add(0, change.rows, change.offsets)
            log_scales = log_scales.index_add(0, change.rows, change.log_scales)
            quats = quats.index_copy(0, change.rows, rotations.multiply(change.quats, quats[change.rows]))
            group = gaussians.motion_ids[change.rows]
            colors, shading = residual.relight(change, colors, shading, self.light, poses.rotmats, group)
        splats = fused_posing.pose(
            means,
            quats,
            log_scales,
            params["opacity_logits"],
            colors,
            shading,
            self.light,
            gaussians.motion_ids,
            poses,
            centers,
        )
        if there is None or (isinstance(there, np.ndarray) and there.all()):
            return splats
        if isinstance(there, np.ndarray):
            there = torch.from_numpy(there).to(means.device, non_blocking=True)
        return dataclasses.replace(splats, opacities=splats.opacities * there[gaussians.motion_ids])

    def penalty(self, gaussians: Gaussians, iteration: int, labels: Callable[[], Tensor]) -> Tensor | None:
        """Return the roughness of the tracks and the penalty of residuals, every `ROUGHNESS_EVERY` steps."""
        weight, section = self._config.losses.roughness, self._config.residual
        if iteration % ROUGHNESS_EVERY or (weight <= 0 and self.residuals is None):
            return None
        total = weight * self.tracks.roughness(self._entered, *self._stiffness)
        if self.residuals is not None:
            total = total + self.residuals.penalty(section.size, section.roughness)
        return ROUGHNESS_EVERY * total

    @torch.no_grad()
    def enter(self, knot: int, towards: int, entered: tuple[int, int]) -> None:
        """Initialise a knot's poses: rotations are extrapolated linearly, displacements follow the path of the masks.

        Beyond the last mask of an object, its displacement is extrapolated linearly, too, as images may still show it.
        """
        self.tracks.rebase()
        self._entered = (min(entered[0], knot), max(entered[1], knot))
        near, next_near = knot + towards, knot + 2 * towards
        quats, shifts = self.tracks.base_quats, self.tracks.params["translations"]
        steady = entered[0] <= next_near <= entered[1]
        ratio, turns = 0.0, shifts.new_zeros(self.tracks.bodies, 3)
        if steady:
            ratio = (self.tracks.times[knot] - self.tracks.times[near]) / (
                self.tracks.times[near] - self.tracks.times[next_near]
            )
            turns = rotations.quats_to_rotvecs(
                rotations.multiply(quats[:, near], rotations.conjugate(quats[:, next_near]))
            )
        quats[:, knot] = rotations.multiply(rotations.rotvecs_to_quats(ratio * turns), quats[:, near])
        for row, (measured, gone) in enumerate(zip(self._places.measured, self._absent, strict=True), start=1):
            beyond = not (measured[: knot + 1] if towards > 0 else measured[knot:]).any()
            if beyond and steady and not gone[[knot, near]].any():
                shifts[row, knot] = shifts[row, near] + ratio * (shifts[row, near] - shifts[row, next_near])
            else:
                shifts[row, knot] = self._displacement(row, knot, near, entered)

    def _displacement(self, row: int, knot: int, near: int, entered: tuple[int, int]) -> Tensor:
        """Return the initial displacement of a body at a knot: that of a neighbour, and the step of the path. [3]

        If the neighbour has drifted from the path, the displacement follows the path at the usual offset instead;
        otherwise each of a series of knots would begin with the drift of all previous ones.
        """
        shifts, path = self.tracks.params["translations"], self._places.centers[row - 1]
        start = shifts[row, near] + torch.from_numpy(path[knot] - path[near]).float().to(
            shifts.device, non_blocking=True
        )
        measured = self._places.measured[row - 1]
        used = entered[0] + np.flatnonzero(measured[entered[0] : entered[1] + 1])
        if not measured[[near, knot]].all() or len(used) < MIN_KNOTS:
            return start
        offsets = shifts[row].cpu().numpy() - path
        usual = np.median(offsets[used], axis=0)
        if np.linalg.norm(offsets[near] - usual) <= DRIFT * self._places.radii[row - 1]:
            return start
        return torch.from_numpy(path[knot] + usual).float().to(shifts.device)

    def after_step(self, gaussians: Gaussians, iteration: int, draw: torch.Generator) -> None:
        """Fold learned rotations into the base rotations every `REBASE_EVERY` steps; end the shading of a ball.

        The assumed shading helps the rotations while times enter. It is then removed, because past t_max it would
        extrapolate what the images have not shown.
        """
        if iteration % REBASE_EVERY == 0:
            self.tracks.rebase()
        config = self._config.train
        if config.representation == TRACKS and iteration == self._config.curriculum.steps(config.iterations)[1]:
            with torch.no_grad():
                gaussians.shading.zero_()

    def tensors(self) -> dict[str, Tensor]:
        """Return the tracks by ``tracks.NAME``, the light direction, and the residuals if there are any."""
        named = track_state.tensors_of(self.tracks)
        named["tracks.entered"] = torch.tensor(self._entered)
        named["light"] = self.light.detach()
        if self._absent.any():
            named[ABSENT] = torch.from_numpy(self._absent)
        if self._gains is not None:
            named[residual.GAINS] = self._gains
        return named if self.residuals is None else named | residual.tensors_of(self.residuals)

    def restored(self, name: str, tensors: dict[str, Tensor]) -> Representation:
        """See `Representation.restored`; the run may already have changed from tracks to a field when the checkpoint
        was written."""
        if not self._config.train.representation == name == FIELD:
            return super().restored(name, tensors)
        from . import field

        return field.FieldRepresentation(self.tracks, self._first, self._config).restored(name, tensors)

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state from `tensors`."""
        self.tracks = track_state.tracks_of(tensors)
        self._owners, self._casters = self.tracks.owners.cpu().numpy(), self.tracks.casters.cpu().numpy()
        first, last = tensors.get("tracks.entered", torch.tensor([0, len(self.tracks.times) - 1])).tolist()
        self._entered = (first, last)
        self.light = tensors["light"].clone().requires_grad_(True)
        self._gains = tensors.get(residual.GAINS)
        self.residuals = residual.residual_of(tensors)

    @staticmethod
    def group_classes(tensors: dict[str, Tensor]) -> np.ndarray:
        """See `Representation.group_classes`: the object of each body; background for shadows."""
        owners = track_state.tracks_of(tensors).owners.cpu().numpy()
        return np.concatenate([owners, np.zeros(len(tensors["tracks.casters"]), np.int64)])

    @staticmethod
    def observed_motion(
        tensors: dict[str, Tensor], object_ids: np.ndarray, observed: np.ndarray, labels: np.ndarray, config: Config
    ) -> ObservedMotion:
        """See `Representation.observed_motion`: the pinned group, the bodies, then the shadows."""
        tracks = track_state.tracks_of(tensors)
        owners = tracks.owners.tolist()
        quats = tracks.knot_quats().detach().numpy().astype(np.float64)
        displacements = tracks.params["translations"].detach().numpy().astype(np.float64)
        centers = tracks.centers.numpy().astype(np.float64)
        follow = tracks.follow_matrix().detach().numpy().astype(np.float64)
        unturned, nowhere = rotations.identity(len(tracks.times)), np.zeros((len(tracks.times), 3))
        groups = [GroupTrack(0, "pinned", centers[0], unturned, nowhere, np.ones(len(tracks.times), bool))]
        gone = {row: tensors[ABSENT][row - 1].numpy() for row in set(owners) - {0}} if ABSENT in tensors else {}
        for body in range(1, tracks.bodies):
            groups.append(
                GroupTrack(
                    int(object_ids[owners[body]]),
                    "body",
                    centers[body],
                    quats[body],
                    displacements[body],
                    observed[owners[body] - 1],
                    absent=gone.get(owners[body]),
                )
            )
        for caster in tracks.casters.tolist():
            groups.append(
                GroupTrack(
                    int(object_ids[owners[caster]]),
                    "shadow",
                    centers[caster],
                    unturned,
                    displacements[caster] @ follow.T,
                    observed[owners[caster] - 1],
                    caster,
                    follow,
                    gone.get(owners[caster]),
                )
            )
        light, field = tensors["light"].numpy().astype(np.float64), residual.residual_of(tensors)
        if field is None:
            return ObservedMotion(tracks.times, tuple(groups), light, smooth=True)
        points, bind = residual.point_motion(field, tracks, tensors)
        return ObservedMotion(tracks.times, tuple(groups), light, bind, points=points, smooth=True)


def first_tracks(first: initialize.FirstTracks) -> Tracks:
    """Return tracks initialised with the positions from the masks, without rotation."""
    base = torch.zeros(*first.translations.shape[:2], 4)
    base[..., 0] = 1.0
    tracks = Tracks(
        first.times,
        torch.from_numpy(first.centers.astype(np.float32)),
        torch.from_numpy(first.translations.astype(np.float32)),
        base,
        torch.from_numpy(first.casters),
        None if first.plane_normal is None else torch.from_numpy(first.plane_normal.astype(np.float32)),
    )
    with torch.no_grad():
        tracks.params["slope"].copy_(torch.from_numpy(first.slope))
    return tracks
