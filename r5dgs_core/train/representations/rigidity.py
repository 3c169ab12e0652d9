"""Rigidity losses: L_rigid of the paper, its absolute form, and the deviation from a group's best rigid motion.

Notation: N Gaussians, C classes, class 0 the background; -1 for none.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...motion import rotations
from ...scene.visibility import SEEN_OPACITY

QUAT_WEIGHT = 0.05  # weight of squared quaternion differences relative to squared distances in normalised units
SOFTENING = 1e-6  # length that keeps the gradient of a distance finite at 0


def representatives(means: Tensor, labels: Tensor, opacities: Tensor) -> Tensor:
    """Return the member nearest to the centroid of each object.

    Only members with an opacity above 0.3 are candidates and count for the centroid, or all members if an object has
    none. Ties go to the first member.

    Args:
        means: Canonical centres. [N, 3]
        labels: Class of each Gaussian; below 1 it belongs to no object. [N] int64
        opacities: In [0, 1]. [N]

    Returns:
        Row of the representative of each class up to the largest label, -1 for the background and for classes without
        members. [C] int64

    Source: R5DGS (Gridusov, Popov, Kolyubin), the anchors of Eq. 6 and 8.
    """
    points, classes = means.detach().double().cpu().numpy(), labels.cpu().numpy()
    count = max(int(classes.max(initial=0)), 0) + 1
    member = classes > 0
    seen = member & (opacities.detach().cpu().numpy() > SEEN_OPACITY)
    members = np.bincount(classes[seen], minlength=count)
    rows = np.flatnonzero(np.where(members[np.maximum(classes, 0)] > 0, seen, member))
    own = classes[rows]
    sums = np.stack([np.bincount(own, points[rows, axis], count) for axis in range(3)], axis=1)
    centroids = sums / np.maximum(np.bincount(own, minlength=count), 1)[:, None]
    distances = ((points[rows] - centroids[own]) ** 2).sum(1)
    order = np.lexsort((rows, distances, own))
    found, first = np.unique(own[order], return_index=True)
    result = np.full(count, -1, np.int64)
    result[found] = rows[order[first]]
    return torch.from_numpy(result).to(labels.device)


def anchors(means: Tensor, labels: Tensor, opacities: Tensor) -> Tensor:
    """Row of the representative of each Gaussian's object, -1 for those of no object; see `representatives`. [N]"""
    rows = representatives(means, labels, opacities)
    return torch.where(labels > 0, rows[labels.clamp(min=0)], -1)


def rigidity(before: Tensor, after: Tensor, anchor_rows: Tensor, form: str) -> Tensor:
    """Return the mean change of the members' distances to the representative of their object.

    Args:
        before: Canonical centres; no gradient reaches them. [N, 3]
        after: Centres at another time. [N, 3]
        anchor_rows: Row of the representative of each Gaussian, -1 for none; representatives and Gaussians without one
            do not count. [N] int64
        form: ``squared``, the paper's L_rigid, or ``absolute``; see `losses.rigid_form`.

    Returns:
        The mean squared or absolute change, a scalar in the unit of the centres or its square; 0 if no Gaussian counts.
        Rigid motions of each object cost nothing. Its gradient is finite everywhere, even if a member coincides with
        its representative.

    Source: R5DGS (Gridusov, Popov, Kolyubin), Eq. 8, for ``squared``; "before" is the canonical state, which the paper
        leaves open. ``absolute`` is ours.
    """
    rows = torch.arange(len(anchor_rows), device=anchor_rows.device)
    members = rows[(anchor_rows >= 0) & (anchor_rows != rows)]
    if len(members) == 0:
        return after.sum() * 0
    centers = anchor_rows[members]
    was, now = (x.index_select(0, members) - x.index_select(0, centers) for x in (before.detach(), after))
    change = _lengths(now) - _lengths(was)
    return (change.square() if form == "squared" else change.abs()).mean()


def stiffness(before: Tensor, after: Tensor, quats: Tensor, log_scales: Tensor, groups: Tensor) -> Tensor:
    """Return the mean squared deviation of positions, rotations and sizes from the best rigid motion of each group.

    Args:
        before: Canonical centres. [R, 3]
        after: Centres at another time. [R, 3]
        quats: Rotations since then, unit wxyz. [R, 4]
        log_scales: Change of the log scales. [R, 3]
        groups: Motion groups; group 0 and groups of fewer than four do not count. [R] int64
    """
    with torch.no_grad():
        turn, shift, known = rigid_fits(before, after, groups)
        goal = rotations.rotate(turn[groups], before) + shift[groups]
        counted = (groups > 0) & known[groups]
        sign = torch.where((quats * turn[groups]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    off = (after - goal).square().sum(-1)
    off = off + QUAT_WEIGHT * ((quats - sign * turn[groups]).square().sum(-1) + log_scales.square().sum(-1))
    return torch.where(counted, off, 0.0).sum() / counted.sum().clamp(min=1)


def rigid_fits(before: Tensor, after: Tensor, groups: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Fit the least-squares rigid motion of each group of points (Kabsch).

    Args:
        before: Points. [R, 3]
        after: The points after the motion. [R, 3]
        groups: Group of each. [R]

    Returns:
        Rotations, unit wxyz [G, 4], shifts [G, 3] of x -> q x q* + shift, and a mask of the groups with enough points.
        [G]
    """
    count = int(groups.max()) + 1 if len(groups) else 0
    n = torch.bincount(groups, minlength=count).to(before.dtype)

    def mean(x: Tensor) -> Tensor:
        return torch.zeros(count, 3, dtype=x.dtype).index_add(0, groups, x) / n.clamp(min=1)[:, None]

    a, b = mean(before), mean(after)
    outer = (after - b[groups])[:, :, None] * (before - a[groups])[:, None, :]
    spread = torch.zeros(count, 3, 3, dtype=before.dtype).index_add(0, groups, outer)
    quats = rotations.rotmats_to_quats(rotations.nearest_rotmats(spread))
    return quats, b - rotations.rotate(quats, a), n >= 4


def _lengths(offsets: Tensor) -> Tensor:
    return ((offsets**2).sum(-1) + SOFTENING**2).sqrt()
