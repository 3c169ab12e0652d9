"""How Gaussians move in the observed time: the border that every representation keeps, and `tracks` behind it.

The trainer knows only `Representation`: splats at a time, what to optimise, a penalty, upkeep, and named tensors for
the checkpoint. `tracks` moves Gaussians by one SE(3) track per object; a deformation field is another class with the
same face.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from ..errors import CheckpointError
from ..model import spherical_harmonics
from ..model.gaussians import Gaussians
from ..model.tracks import Tracks
from ..motion import rotations
from ..raster import harmonics
from ..scene.cameras import Camera
from . import initialization, posing, triangulation
from .config import Config

ROUGHNESS_EVERY = 4  # the roughness of the tracks is added every so many steps, with so many times the weight
REBASE_EVERY = 100


@dataclass(frozen=True)
class GroupTrack:
    """One motion group over the knots, in training coordinates: x -> c + R (x - c) + d from the canonical state.

    Attributes:
        object_id: Object that it belongs to; a shadow's caster.
        role: "pinned", "body" or "shadow".
        center: The fixed centre c. [3]
        quats: Rotations at the knots, unit wxyz. [S, 4]
        displacements: Displacements at the knots. [S, 3]
        observed: Knots at which the object was seen well enough to be placed. [S] bool
        follows: Group whose displacement it takes through ``follow_matrix``, or None.
        follow_matrix: That map. [3, 3]
    """

    object_id: int
    role: str
    center: np.ndarray
    quats: np.ndarray
    displacements: np.ndarray
    observed: np.ndarray
    follows: int | None = None
    follow_matrix: np.ndarray | None = None


@dataclass(frozen=True)
class ObservedMotion:
    """What a trained representation hands to baking: knots [S], groups by id, and the light of the shading [3]."""

    times: np.ndarray
    groups: tuple[GroupTrack, ...]
    light: np.ndarray


class Representation(Protocol):
    """The observed motion of N Gaussians, in training coordinates.

    Attributes:
        name: Its name in the configuration.
    """

    name: str

    @property
    def params(self) -> dict[str, Tensor]:
        """What the optimizer moves, by the names of the learning rates."""
        ...

    def splats(self, gaussians: Gaussians, camera: Camera, t: float) -> posing.Splats:
        """Activated Gaussians in the world at a time, coloured as a camera sees them; differentiable."""
        ...

    def penalty(self, iteration: int) -> Tensor | None:
        """What is added to the loss of a step, or None."""
        ...

    def enter(self, knot: int, towards: int, entered: tuple[int, int]) -> None:
        """An observed time joins the training: ``knot`` from its neighbours in direction ``towards`` (+1 or -1)."""
        ...

    def after_step(self, iteration: int) -> None:
        """Upkeep after ``iteration`` steps."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """Everything that must be stored, by name."""
        ...

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from `tensors`."""
        ...

    @staticmethod
    def observed_motion(tensors: dict[str, Tensor], object_ids: np.ndarray, observed: np.ndarray) -> ObservedMotion:
        """Motion groups out of a checkpoint's `tensors`.

        Args:
            tensors: By name, as stored.
            object_ids: Object id of each class, 0 first. [B]
            observed: Knots at which each object was placed by its masks. [B - 1, S] bool
        """
        ...


class TracksRepresentation:
    """One SE(3) track per object, with shading that turns in fixed light and shadows that follow their caster.

    Args:
        tracks: Start of the tracks.
        places: Where the masks put the objects, for the translation of knots that enter.
        config: The run's configuration.
    """

    name = "tracks"

    def __init__(self, tracks: Tracks, places: triangulation.Places, config: Config):
        self.tracks = tracks
        self.light = torch.tensor([0.0, 0.0, 1.0], requires_grad=True)
        self._places = places
        self._config = config

    @property
    def params(self) -> dict[str, Tensor]:
        """Tracks and light direction."""
        return {**self.tracks.params, "light": self.light}

    def splats(self, gaussians: Gaussians, camera: Camera, t: float) -> posing.Splats:
        """See `Representation.splats`."""
        poses = self.tracks.poses(t)
        centers = self.tracks.group_centers()
        params = gaussians.params
        if params["sh_rest"].shape[1] == 0:
            colors = spherical_harmonics.dc_to_rgb(params["sh"][:, 0])
        else:
            # The harmonics live in each group's own frame, so the eye is taken back into it.
            with torch.no_grad():
                arm = centers + poses.displacements - torch.from_numpy(camera.center).float()
                eyes = centers - (poses.rotmats.transpose(1, 2) @ arm[..., None])[..., 0]
            colors = harmonics.seen_colors(
                params["means"].detach(),
                params["sh"],
                eyes.numpy(),
                rest=params["sh_rest"],
                pose_ids=gaussians.motion_ids,
            )
        return posing.pose(
            params["means"],
            params["quats"],
            params["log_scales"],
            params["opacity_logits"],
            colors,
            params["shading"],
            self.light,
            gaussians.motion_ids,
            poses,
            centers,
        )

    def penalty(self, iteration: int) -> Tensor | None:
        """Roughness of the tracks, now and then with the weight of the steps in between."""
        weight = self._config.losses.roughness
        if weight <= 0 or iteration % ROUGHNESS_EVERY:
            return None
        return ROUGHNESS_EVERY * weight * self.tracks.roughness()

    @torch.no_grad()
    def enter(self, knot: int, towards: int, entered: tuple[int, int]) -> None:
        """Start a knot's poses from its entered neighbours: steady rotation, triangulated translation."""
        self.tracks.rebase()
        near, next_near = knot + towards, knot + 2 * towards
        quats, shifts = self.tracks.base_quats, self.tracks.params["translations"]
        steady = entered[0] <= next_near <= entered[1]
        turn = rotations.multiply(quats[:, near], rotations.conjugate(quats[:, next_near])) if steady else None
        quats[:, knot] = quats[:, near] if turn is None else rotations.multiply(turn, quats[:, near])
        for row in range(1, self.tracks.bodies):
            if self._places.measured[row - 1, knot] and self._places.measured[row - 1, near]:
                here, there = (self._places.centers[row - 1, k] for k in (knot, near))
                shifts[row, knot] = shifts[row, near] + torch.from_numpy(here - there).float()
            elif steady:
                shifts[row, knot] = 2 * shifts[row, near] - shifts[row, next_near]

    def after_step(self, iteration: int) -> None:
        """Fold learned rotations into the base."""
        if iteration % REBASE_EVERY == 0:
            self.tracks.rebase()

    def tensors(self) -> dict[str, Tensor]:
        """Tracks by ``tracks.NAME`` and the light direction."""
        tracks = self.tracks
        named: dict[str, Any] = {f"tracks.{n}": p.detach() for n, p in tracks.params.items()}
        named["tracks.times"] = torch.from_numpy(tracks.times)
        for name in ("centers", "base_quats", "casters", "plane_normal"):
            named[f"tracks.{name}"] = getattr(tracks, name)
        named["light"] = self.light.detach()
        return named

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from `tensors`."""
        self.tracks = tracks_of(tensors)
        self.light = tensors["light"].clone().requires_grad_(True)

    @staticmethod
    def observed_motion(tensors: dict[str, Tensor], object_ids: np.ndarray, observed: np.ndarray) -> ObservedMotion:
        """See `Representation.observed_motion`: the pinned group, one body per object, then the shadows."""
        tracks = tracks_of(tensors)
        quats = tracks.knot_quats().detach().numpy().astype(np.float64)
        displacements = tracks.params["translations"].detach().numpy().astype(np.float64)
        centers = tracks.centers.numpy().astype(np.float64)
        follow = tracks.follow_matrix().detach().numpy().astype(np.float64)
        still, nowhere = rotations.identity(len(tracks.times)), np.zeros((len(tracks.times), 3))
        groups = [GroupTrack(0, "pinned", centers[0], still, nowhere, np.ones(len(tracks.times), bool))]
        for body in range(1, tracks.bodies):
            groups.append(
                GroupTrack(
                    int(object_ids[body]),
                    "body",
                    centers[body],
                    quats[body],
                    displacements[body],
                    observed[body - 1],
                )
            )
        for caster in tracks.casters.tolist():
            groups.append(
                GroupTrack(
                    int(object_ids[caster]),
                    "shadow",
                    centers[caster],
                    still,
                    displacements[caster] @ follow.T,
                    observed[caster - 1],
                    caster,
                    follow,
                )
            )
        return ObservedMotion(tracks.times, tuple(groups), tensors["light"].numpy().astype(np.float64))


REPRESENTATIONS: dict[str, type[TracksRepresentation]] = {TracksRepresentation.name: TracksRepresentation}


def make(start: initialization.Start, config: Config) -> Representation:
    """The representation that the configuration asks for, at the start of training."""
    return REPRESENTATIONS[config.train.representation](start.tracks, start.places, config)


def observed_motion(
    name: str, tensors: dict[str, Tensor], object_ids: np.ndarray, observed: np.ndarray
) -> ObservedMotion:
    """Motion groups out of a checkpoint of the representation ``name``.

    Raises:
        CheckpointError: This version has no such representation.
    """
    if name not in REPRESENTATIONS:
        known = ", ".join(REPRESENTATIONS)
        raise CheckpointError(f"the checkpoint was trained with representation '{name}'; this version knows {known}")
    return REPRESENTATIONS[name].observed_motion(tensors, object_ids, observed)


def group_classes(groups: Sequence[GroupTrack], object_ids: np.ndarray) -> np.ndarray:
    """Class that a group's Gaussians have where no mask says otherwise: a body's object, else the background. [G]"""
    row = {int(object_id): k for k, object_id in enumerate(object_ids)}
    return np.array([row[g.object_id] if g.role == "body" else 0 for g in groups], np.int64)


def tracks_of(tensors: dict[str, Tensor]) -> Tracks:
    """The tracks in a checkpoint's named tensors."""
    tracks = Tracks(
        tensors["tracks.times"].numpy(),
        tensors["tracks.centers"],
        tensors["tracks.translations"].clone(),
        tensors["tracks.base_quats"].clone(),
        tensors["tracks.casters"],
        tensors["tracks.plane_normal"],
    )
    for name in ("rotvecs", "slope"):
        tracks.params[name] = tensors[f"tracks.{name}"].clone().requires_grad_(True)
    return tracks
