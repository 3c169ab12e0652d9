"""Rigidity losses: L_rigid of the paper, its absolute form, and the deviation from a group's best rigid motion.

Notation: N Gaussians, C classes, class 0 the background; -1 for none.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...motion import rotations
from ...raster import arrays
from ...scene.visibility import SEEN_OPACITY

QUAT_WEIGHT = 0.05  # weight of squared quaternion differences relative to squared distances in normalised units
SQUARINGS = 6  # times four squares of a matrix: eigenvalues that differ by 1e-5 are separated
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


def _representatives_in_torch(means: Tensor, labels: Tensor, opacities: Tensor, count: int) -> Tensor:
    """Implement `representatives` for tensors on other devices. [count]"""
    points, own, member = means.detach().double(), labels.clamp(min=0), labels > 0
    seen = member & (opacities.detach() > SEEN_OPACITY)
    zeros = points.new_zeros(count)
    with_seen = zeros.index_add(0, own, seen.double()) > 0
    chosen = torch.where(with_seen[own], seen, member)
    sums = points.new_zeros(count, 3).index_add(0, own, points * chosen[:, None])
    centroids = sums / zeros.index_add(0, own, chosen.double()).clamp(min=1)[:, None]
    distances = torch.where(chosen, (points - centroids[own]).square().sum(1), torch.inf)
    least = torch.full_like(zeros, torch.inf).scatter_reduce(0, own, distances, "amin")
    rows = torch.arange(len(own), device=own.device)
    nearest = torch.where(chosen & (distances == least[own]), rows, len(own))
    result = torch.full_like(own[:1], len(own)).expand(count).scatter_reduce(0, own, nearest, "amin")
    return torch.where(result < len(own), result, -1)


def anchors(means: Tensor, labels: Tensor, opacities: Tensor, count: int) -> Tensor:
    """Row of the representative of each Gaussian's object, -1 for those of no object; see `representatives`. [N]

    Args:
        means: Canonical centres. [N, 3]
        labels: Class of each Gaussian; below 1 it belongs to no object. [N] int64
        opacities: In [0, 1]. [N]
        count: Number of classes.
    """
    if arrays.takes_kernels(means):
        rows = representatives(means, labels, opacities)
    else:
        rows = _representatives_in_torch(means, labels, opacities, count)
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
    counted = (anchor_rows >= 0) & (anchor_rows != rows)
    if not arrays.takes_kernels(after):  # a GPU computes all rows faster than it returns the number of members
        centers = anchor_rows.clamp(min=0)
        was, now = (_lengths(x - x.index_select(0, centers)) for x in (before.detach(), after))
        size = (now - was).square() if form == "squared" else (now - was).abs()
        return torch.where(counted, size, 0.0).sum() / counted.sum().clamp(min=1)
    members = rows[counted]
    if len(members) == 0:
        return after.sum() * 0
    centers = anchor_rows[members]
    was, now = (x.index_select(0, members) - x.index_select(0, centers) for x in (before.detach(), after))
    change = _lengths(now) - _lengths(was)
    return (change.square() if form == "squared" else change.abs()).mean()


def stiffness(before: Tensor, after: Tensor, quats: Tensor, log_scales: Tensor, groups: Tensor, count: int) -> Tensor:
    """Return the mean squared deviation of positions, rotations and sizes from the best rigid motion of each group.

    Args:
        before: Canonical centres. [R, 3]
        after: Centres at another time. [R, 3]
        quats: Rotations since then, unit wxyz. [R, 4]
        log_scales: Change of the log scales. [R, 3]
        groups: Motion groups; group 0 and groups of fewer than four do not count. [R] int64
        count: Number of groups G.
    """
    with torch.no_grad():
        turn, shift, known = rigid_fits(before, after, groups, count)
        goal = rotations.rotate(turn[groups], before) + shift[groups]
        counted = (groups > 0) & known[groups]
        sign = torch.where((quats * turn[groups]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    off = (after - goal).square().sum(-1)
    off = off + QUAT_WEIGHT * ((quats - sign * turn[groups]).square().sum(-1) + log_scales.square().sum(-1))
    return torch.where(counted, off, 0.0).sum() / counted.sum().clamp(min=1)


def rigid_fits(before: Tensor, after: Tensor, groups: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Fit the least-squares rigid motion of each group of points (Kabsch).

    Args:
        before: Points. [R, 3]
        after: The points after the motion. [R, 3]
        groups: Group of each. [R]
        count: Number of groups G.

    Returns:
        Rotations, unit wxyz [G, 4], shifts [G, 3] of x -> q x q* + shift, and a mask of the groups with enough points.
        [G]
    """
    n = before.new_zeros(count).index_add(0, groups, torch.ones_like(before[:, 0]))

    def mean(x: Tensor) -> Tensor:
        return x.new_zeros(count, 3).index_add(0, groups, x) / n.clamp(min=1)[:, None]

    a, b = mean(before), mean(after)
    outer = (after - b[groups])[:, :, None] * (before - a[groups])[:, None, :]
    spread = before.new_zeros(count, 3, 3).index_add(0, groups, outer)
    if arrays.takes_kernels(spread):
        quats = rotations.rotmats_to_quats(rotations.nearest_rotmats(spread))
    else:
        quats = _nearest_quats(spread)
    return quats, b - rotations.rotate(quats, a), n >= 4


def _nearest_quats(spread: Tensor) -> Tensor:
    """Return the rotations nearest to matrices without a decomposition, which makes a GPU wait. [G, 3, 3] -> [G, 4]

    The quaternion is the eigenvector of the largest eigenvalue of a symmetric matrix; repeated squares of the matrix
    converge to its projector.

    Source: Horn 1987, section 4.
    """
    s = spread.double()
    trace = s.diagonal(dim1=-2, dim2=-1).sum(-1)
    axis = torch.stack([s[:, 2, 1] - s[:, 1, 2], s[:, 0, 2] - s[:, 2, 0], s[:, 1, 0] - s[:, 0, 1]], -1)
    corner = s + s.mT - trace[:, None, None] * torch.eye(3, dtype=s.dtype, device=s.device)
    top = torch.cat([trace[:, None], axis], -1)
    matrix = torch.cat([top[:, None], torch.cat([axis[..., None], corner], -1)], 1)
    size = matrix.square().sum((-2, -1), keepdim=True).sqrt().clamp(min=1e-300)
    projector = matrix / size + torch.eye(4, dtype=s.dtype, device=s.device)  # no negative eigenvalues
    for _ in range(SQUARINGS):
        projector = projector / projector.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
        for _ in range(4):
            projector = projector @ projector
    column = projector.diagonal(dim1=-2, dim2=-1).argmax(-1)
    return rotations.normalize(projector.gather(2, column[:, None, None].expand(-1, 4, 1))[..., 0]).to(spread.dtype)


def _lengths(offsets: Tensor) -> Tensor:
    return ((offsets**2).sum(-1) + SOFTENING**2).sqrt()
