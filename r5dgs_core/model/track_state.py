"""Conversion of tracks to and from the named tensors of a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from .tracks import Tracks

OWNERS = "tracks.owners"  # only present if an object has several parts


def tensors_of(tracks: Tracks) -> dict[str, Tensor]:
    """Return the tensors of tracks, named ``tracks.NAME``."""
    named = {f"tracks.{name}": parameter.detach() for name, parameter in tracks.params.items()}
    named["tracks.times"] = torch.from_numpy(tracks.times)
    for name in ("centers", "base_quats", "casters", "plane_normal"):
        named[f"tracks.{name}"] = getattr(tracks, name)
    if not torch.equal(tracks.owners, torch.arange(tracks.bodies, device=tracks.owners.device)):
        named[OWNERS] = tracks.owners
    return named


def tracks_of(tensors: Mapping[str, Tensor]) -> Tracks:
    """Restore tracks from the named tensors of a checkpoint."""
    tracks = Tracks(
        tensors["tracks.times"].cpu().numpy(),
        tensors["tracks.centers"],
        tensors["tracks.translations"].clone(),
        tensors["tracks.base_quats"].clone(),
        tensors["tracks.casters"],
        tensors["tracks.plane_normal"],
        tensors.get(OWNERS),
    )
    for name in ("rotvecs", "slope"):
        tracks.params[name] = tensors[f"tracks.{name}"].clone().requires_grad_(True)
    return tracks
