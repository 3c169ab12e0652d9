"""Thinning of the initial Gaussians to the configured cap."""

from __future__ import annotations

import math

import numpy as np
import torch

from ...model.gaussians import Gaussians

WIDEST = 0.25  # normalised units; wider ones would soon be pruned


def thin(gaussians: Gaussians, cap: int, rng: np.random.Generator) -> Gaussians:
    """Keep ``cap`` Gaussians: the same share of every motion group, and at least one of each if possible.

    The remaining ones grow by the square root of the reduction so that surfaces stay covered, up to a size of `WIDEST`.

    Args:
        gaussians: The Gaussians before training.
        cap: Maximum number of them, at least 1.
        rng: Random generator; not used if no thinning is necessary.

    Returns:
        The remaining Gaussians in their order; ``gaussians`` itself if there are at most ``cap``.
    """
    count = len(gaussians)
    if count <= cap:
        return gaussians
    drawn = rng.permutation(count)
    ids = gaussians.motion_ids.numpy()[drawn]
    turn = np.zeros(count)  # order of selection: rank in the group / size of the group
    for group in np.unique(ids):
        members = ids == group
        turn[members] = np.arange(members.sum()) / members.sum()
    rows = torch.from_numpy(np.sort(drawn[np.argsort(turn, kind="stable")[:cap]]))
    params = {name: tensor.detach()[rows].clone() for name, tensor in gaussians.params.items()}
    room = math.log(WIDEST) - params["log_scales"].amax(1, keepdim=True)
    params["log_scales"] += room.clamp(0.0, 0.5 * math.log(count / cap))
    return Gaussians(params, gaussians.motion_ids[rows])
