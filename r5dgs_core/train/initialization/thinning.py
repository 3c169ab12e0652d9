"""Fewer Gaussians to start from, where a cap is below what was placed."""

from __future__ import annotations

import math

import numpy as np
import torch

from ...model.gaussians import Gaussians

WIDEST = 0.25  # normalised units; wider ones would soon be pruned


def thin(gaussians: Gaussians, cap: int, rng: np.random.Generator) -> Gaussians:
    """Keep ``cap`` Gaussians, the same share of every motion group and one of each as long as there is room.

    Those that stay grow by the square root of the factor by which they became fewer, so that surfaces stay covered, but
    not beyond `WIDEST`.

    Args:
        gaussians: The Gaussians before training.
        cap: Largest number of them, at least 1.
        rng: Source of the draws; not asked where there are few enough already.

    Returns:
        The Gaussians that stay, in their order; ``gaussians`` itself where there are few enough.
    """
    count = len(gaussians)
    if count <= cap:
        return gaussians
    drawn = rng.permutation(count)
    ids = gaussians.motion_ids.numpy()[drawn]
    turn = np.zeros(count)  # when a Gaussian is taken: its place in its group, as a share of the group
    for group in np.unique(ids):
        members = ids == group
        turn[members] = np.arange(members.sum()) / members.sum()
    rows = torch.from_numpy(np.sort(drawn[np.argsort(turn, kind="stable")[:cap]]))
    params = {name: tensor.detach()[rows].clone() for name, tensor in gaussians.params.items()}
    room = math.log(WIDEST) - params["log_scales"].amax(1, keepdim=True)
    params["log_scales"] += room.clamp(0.0, 0.5 * math.log(count / cap))
    return Gaussians(params, gaussians.motion_ids[rows])
