"""Transition from tracks to a field: the Gaussians move to one time, and the field is fitted to the tracks' motion."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...config.config import Config
from ...model.gaussians import Gaussians
from ...model.tracks import Tracks
from ...motion import rotations
from ...scene import spherical_harmonics
from . import field, gating, shading


def from_tracks(
    tracks: Tracks, light: Tensor, gaussians: Gaussians, first: int, config: Config, draw: torch.Generator
) -> field.FieldRepresentation:
    """Return a field that continues from tracks: it is fitted to their motion, with all Gaussians at one time.

    Args:
        tracks: The trained tracks.
        light: The trained light of the shading. [3]
        gaussians: Changed in place: each body moves from its own canonical state to its pose at ``first``.
        first: Knot at which the field's Gaussians are canonical.
        config: The run's configuration.
        draw: Random generator.
    """
    made = field.FieldRepresentation(tracks, first, config).to(light.device)
    with torch.no_grad():
        made.light.copy_(light)
    pose_at_knot(gaussians, tracks, first, light.detach())
    gating.release_background(gaussians, tracks, config)
    made.fit(gaussians, tracks, config.field.distill_steps, config.field.distill_steps, draw)
    return made


def pose_at_knot(gaussians: Gaussians, tracks: Tracks, knot: int, light: Tensor | None = None) -> None:
    """Move each group of Gaussians from its own reference time to its pose at one knot, in place.

    Args:
        gaussians: The Gaussians.
        tracks: Tracks of their groups.
        knot: The knot.
        light: Light of their shading; None leaves colours unchanged. [3]
    """
    with torch.no_grad():
        poses = tracks.poses(float(tracks.times[knot]))
        ids, centers = gaussians.motion_ids, tracks.group_centers()
        means, quats = gaussians.means, gaussians.quats
        arm = (means - centers[ids])[..., None]
        means.copy_((poses.rotmats[ids] @ arm)[..., 0] + centers[ids] + poses.displacements[ids])
        quats.copy_(rotations.multiply(poses.quats[ids], quats))
        if light is None:
            return
        sh = torch.cat([gaussians.sh, gaussians.sh_rest], dim=1).double().cpu().numpy()
        vectors, turns = gaussians.shading.double().cpu().numpy(), poses.quats[ids].double().cpu().numpy()
        sh = spherical_harmonics.rotate(sh, turns)
        # Unlit surfaces start dark; factors at rest are dropped, as training assumes 1.
        sh, vectors, _ = shading.rebind(sh, vectors, np.ones(len(sh)), turns, light.double().cpu().numpy())
        gaussians.sh.copy_(torch.from_numpy(sh[:, :1]))
        gaussians.sh_rest.copy_(torch.from_numpy(sh[:, 1:]))
        gaussians.shading.copy_(torch.from_numpy(vectors))
