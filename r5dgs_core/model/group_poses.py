"""Poses of all motion groups at one time."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class GroupPoses:
    """Poses of all groups at one time: unit quats [G, 4], their matrices [G, 3, 3], displacements [G, 3]."""

    quats: Tensor
    rotmats: Tensor
    displacements: Tensor


def at_rest(count: int) -> GroupPoses:
    """Return the identity pose for all groups."""
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1.0
    return GroupPoses(quats, torch.eye(3).expand(count, 3, 3).contiguous(), torch.zeros(count, 3))
