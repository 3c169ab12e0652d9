"""How Gaussians move in the observed time: the border that every representation keeps, and `tracks` behind it.

The trainer knows only `Representation`: splats at a time, what to optimise, a penalty, upkeep, and named tensors for
the checkpoint. `tracks` moves Gaussians by one SE(3) track per object; a deformation field is another class with the
same face.
"""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor

from ..model import spherical_harmonics
from ..model.gaussians import Gaussians
from ..model.tracks import Tracks
from ..motion import rotations
from ..scene.cameras import Camera
from . import posing, triangulation
from .config import Config

ROUGHNESS_EVERY = 4  # the roughness of the tracks is added every so many steps, with so many times the weight
REBASE_EVERY = 100


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
        colors = spherical_harmonics.dc_to_rgb(params["sh"][:, 0])
        if params["sh_rest"].shape[1] > 0:
            # Directions are taken back into each group's own frame, where the harmonics live.
            with torch.no_grad():
                arm = centers + poses.displacements - torch.from_numpy(camera.center).float()
                eyes = centers - (poses.rotmats.transpose(1, 2) @ arm[..., None])[..., 0]
                towards = params["means"] - eyes[gaussians.motion_ids]
                directions = towards / towards.norm(dim=-1, keepdim=True).clamp(min=1e-9)
                degree = spherical_harmonics.degree_of(params["sh_rest"].shape[1] + 1)
                basis = spherical_harmonics.basis(directions, degree)[:, 1:]
            colors = colors + (basis[..., None] * params["sh_rest"]).sum(-2)
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
