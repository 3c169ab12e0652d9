"""Tracks as named tensors of a checkpoint, and back."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from .tracks import Tracks


def tensors_of(tracks: Tracks) -> dict[str, Tensor]:
    """Tracks by ``tracks.NAME``."""
    named = {f"tracks.{name}": parameter.detach() for name, parameter in tracks.params.items()}
    named["tracks.times"] = torch.from_numpy(tracks.times)
    for name in ("centers", "base_quats", "casters", "plane_normal"):
        named[f"tracks.{name}"] = getattr(tracks, name)
    return named


def tracks_of(tensors: Mapping[str, Tensor]) -> Tracks:
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
