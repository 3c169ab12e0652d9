"""Residual field: deviation of flexible bodies from their rigid track, interpolated from nodes on each body.

Notation: Q nodes of all flexible bodies together, S knots, n members of a body. Node j at the canonical position p_j,
on a body of length h, has at each knot an offset d_j and three rows l_j, the change of the offset per length h along
each axis. With normalised weights w_j(x) that fall off over the spacing of the nodes, a member at x gets

    offset o(x) = sum_j w_j (d_j + l_j^T (x - p_j) / h),    gradient F(x) = I + sum_j w_j l_j^T / h

F rotates the Gaussian and stretches its axes. The rigid part of o belongs to the track and is removed, to first order.
Between knots, values follow the curve of the tracks.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..motion import rotations
from ..scene.visibility import SEEN_OPACITY
from .remembered import Remembered


@dataclass(frozen=True)
class Change:
    """Effect of a field on the members of its bodies, in canonical coordinates.

    Attributes:
        rows: Rows of the members among all Gaussians. [n] int64
        offsets: Added to the centres. [n, 3]
        quats: Rotations applied after those of the Gaussians (turn q), unit wxyz. [n, 4]
        log_scales: Added to the log scales. [n, 3]
    """

    rows: Tensor
    offsets: Tensor
    quats: Tensor
    log_scales: Tensor


class ResidualField:
    """Nodes on the flexible bodies with their values at the knots. Zero values change nothing.

    All F bodies are evaluated in one batch, padded to the largest numbers of members and nodes.

    Args:
        nodes: Canonical positions. [Q, 3]
        owners: Motion group of each node. [Q] int64
        values: d and the rows of l at the knots. [S, Q, 4, 3]
        sizes: Length and spacing of each body, by id, of a field with the same nodes; None to measure them.
    """

    def __init__(
        self,
        nodes: Tensor,
        owners: Tensor,
        values: Tensor,
        sizes: dict[int, tuple[float, float]] | None = None,
    ):
        self.nodes = nodes
        self.owners = owners
        self.values = values.detach().requires_grad_(True)
        bodies, body_of = owners.unique(return_inverse=True)
        self.bodies: list[int] = bodies.tolist()
        self._slots, self._there = _padded(owners, self.bodies)
        self._sizes = sizes or {body: _lengths(nodes[owners == body]) for body in self.bodies}
        mine = [self._sizes[body] for body in self.bodies]
        self._lengths = nodes.new_tensor([length for length, _ in mine]).reshape(-1, 1, 1)
        self._spacings = nodes.new_tensor([spacing for _, spacing in mine]).reshape(-1, 1, 1)
        shares = nodes.new_tensor([1 / length for length, _ in mine]).reshape(-1, 1, 1)
        self._share = shares[body_of]  # 1 / length of each node's body
        self._members: Remembered[tuple[Tensor, Tensor, Tensor]] = Remembered()

    def only(self, bodies: list[int]) -> ResidualField:
        """Return the field of some of its bodies."""
        kept = torch.isin(self.owners, self.owners.new_tensor(bodies))
        return ResidualField(self.nodes[kept], self.owners[kept], self.values.detach()[:, kept].clone(), self._sizes)

    def change(
        self,
        means: Tensor,
        quats: Tensor,
        opacities: Tensor,
        motion_ids: Tensor,
        weights: dict[int, float] | Tensor,
    ) -> Change:
        """Return the change of the members at a time; differentiable in the values and ``quats``.

        Args:
            means: Canonical centres of all Gaussians. [N, 3]
            quats: Their rotations wxyz, any positive norm. [N, 4]
            opacities: Weights of the members in the rigid motion that is removed. [N]
            motion_ids: Their motion groups. [N] int64
            weights: Weights of the knots at that time, or one knot as an int64 tensor [1].
        """
        index, there, kept = self._members.of(motion_ids, self._members_of)
        if len(kept) == 0:
            none = means.new_zeros(0, 3)
            return Change(motion_ids.new_zeros(0), none, means.new_zeros(0, 4), none)
        if isinstance(weights, Tensor):
            mixed = self.values.index_select(0, weights)[0]
        else:
            mixed = torch.zeros_like(self.values[0])
            for s, weight in weights.items():
                mixed = mixed + weight * self.values[s]
        x, share = means.detach()[index], opacities.detach()[index] * there
        offsets, slopes = self._blend(x, mixed[self._slots])
        middle = x - _mean(x, share)
        shift, spin = _rigid_part(middle, offsets, share)
        offsets = offsets - shift - torch.linalg.cross(spin[:, None].expand_as(middle), middle)
        slopes = slopes - _cross_matrix(spin)[:, None]
        where = index.flatten()[kept]
        gradient = slopes.flatten(0, 1)[kept] + torch.eye(3, dtype=means.dtype, device=means.device)
        stretched = gradient @ rotations.quats_to_rotmats(rotations.normalize(quats[where]))
        growth = 0.5 * torch.log((stretched**2).sum(-2).clamp(min=1e-4))
        return Change(where, offsets.flatten(0, 1)[kept], _turn(gradient), growth)

    def penalty(self, size: float, roughness: float) -> Tensor:
        """Weighted sum of the mean squared value and second difference over the knots, relative to the body's length.

        Args:
            size: Weight of the values.
            roughness: Weight of their second differences.
        """
        scaled = self.values * self._share
        total = size * (scaled**2).mean()
        if len(scaled) > 2:
            total = total + roughness * ((scaled[2:] - 2 * scaled[1:-1] + scaled[:-2]) ** 2).mean()
        return total

    def _members_of(self, motion_ids: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Members of each body, padded, the mask of valid entries [F, n], and the valid entries of both, flattened."""
        index, there = _padded(motion_ids, self.bodies)
        return index, there, torch.nonzero(there.flatten())[:, 0]

    def _blend(self, x: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Offsets [F, n, 3] of members at x and their gradients, one column per axis of x, [F, n, 3, 3]."""
        nodes = self.nodes[self._slots]
        squared = (x**2).sum(-1, keepdim=True) - 2 * x @ nodes.mT + (nodes**2).sum(-1)[:, None]
        squared = squared / (2 * self._spacings**2)
        weights = torch.softmax(torch.where(self._there[:, None], -squared, -torch.inf), dim=-1)
        slopes = values[:, :, 1:] / self._lengths[..., None]  # row: axis of x, column: component of the offset
        base = values[:, :, 0] - (nodes[:, :, None] @ slopes)[:, :, 0]
        flat = weights @ torch.cat([base, slopes.flatten(2)], -1)
        gradient = flat[..., 3:].unflatten(-1, (3, 3))
        return flat[..., :3] + (x[..., None, :] @ gradient)[..., 0, :], gradient.mT


def _padded(ids: Tensor, bodies: list[int]) -> tuple[Tensor, Tensor]:
    """Rows with the id of each body, ascending, padded with zeros, and the mask of valid entries. [F, largest count]"""
    wanted = ids.new_tensor(bodies)  # ascending
    rows = torch.nonzero(torch.isin(ids, wanted))[:, 0]
    slots, order = torch.searchsorted(wanted, ids[rows]).sort(stable=True)
    counts = torch.bincount(slots, minlength=len(bodies))
    columns = torch.arange(len(rows), device=ids.device) - (counts.cumsum(0) - counts)[slots]
    index = ids.new_zeros(len(bodies), int(counts.max()) if bodies else 0, dtype=torch.int64)
    there = torch.zeros_like(index, dtype=torch.bool)
    index[slots, columns], there[slots, columns] = rows[order], True
    return index, there


def spread(
    means: Tensor, motion_ids: Tensor, opacities: Tensor, bodies: list[int], count: int, knots: int
) -> ResidualField:
    """Create a zero field with nodes on the members of bodies, by farthest point sampling.

    Args:
        means: Canonical centres of all Gaussians. [N, 3]
        motion_ids: Their motion groups. [N] int64
        opacities: Members below `SEEN_OPACITY` get no node, unless the body has no others. [N]
        bodies: Motion groups that get nodes, if they have members.
        count: Maximum number of nodes per body.
        knots: Number of knots S.
    """
    nodes, owners = [means.new_zeros(0, 3)], [motion_ids.new_zeros(0, dtype=torch.int64)]
    for body in bodies:
        members = motion_ids == body
        seen = members & (opacities > SEEN_OPACITY)
        points = means.detach()[seen if seen.any() else members]
        if len(points) == 0:
            continue
        middle = points.median(0).values
        reach = (points - middle).norm(dim=1)
        points = points[reach <= 1.5 * reach.quantile(0.9)]  # outliers would take nodes from the body
        chosen = _far_apart(points, middle, min(count, len(points)))
        nodes.append(points[chosen])
        owners.append(motion_ids.new_full((len(chosen),), body, dtype=torch.int64))
    place = torch.cat(nodes)
    return ResidualField(place, torch.cat(owners), means.new_zeros(knots, len(place), 4, 3))


def _far_apart(points: Tensor, start: Tensor, count: int) -> Tensor:
    """Farthest point sampling: indices of ``count`` points, the first farthest from ``start``."""
    chosen = [int((points - start).norm(dim=1).argmax())]
    distance = (points - points[chosen[0]]).norm(dim=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (points - points[chosen[-1]]).norm(dim=1))
    return torch.tensor(chosen, device=points.device)


def _lengths(nodes: Tensor) -> tuple[float, float]:
    """Length of a body (root mean square distance from its mean) and spacing of its nodes (mean nearest distance)."""
    length = float((nodes - nodes.mean(0)).pow(2).sum(1).mean().sqrt())
    if len(nodes) < 2 or length <= 0:
        return max(length, 1e-3), 1.0
    distance = torch.cdist(nodes, nodes)
    distance.fill_diagonal_(torch.inf)
    return length, max(float(distance.min(1).values.mean()), 1e-6)


def _mean(x: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean of each body. [F, n, 3] -> [F, 1, 3]"""
    return (weights[..., None] * x).sum(1, keepdim=True) / weights.sum(1).clamp(min=1e-9)[:, None, None]


def _rigid_part(middle: Tensor, offsets: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted least-squares fit of the offsets by a mean offset [F, 1, 3] and a small rotation about the mean [F, 3].

    Args:
        middle: Members relative to their weighted mean. [F, n, 3]
        offsets: Offsets of the members. [F, n, 3]
        weights: Weights of the members. [F, n]
    """
    shift = _mean(offsets, weights)
    squares = (weights[..., None] * middle).mT @ middle
    trace = squares.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
    one = torch.eye(3, dtype=middle.dtype, device=middle.device)
    inertia = one * trace - squares + (1e-6 * trace + 1e-12) * one  # regularised: a line does not determine its spin
    moment = (weights[..., None] * torch.linalg.cross(middle, offsets - shift)).sum(1)
    inverse, _ = torch.linalg.inv_ex(inertia)  # does not wait for a GPU, as it does not check
    return shift, (inverse @ moment[..., None])[..., 0]


def _cross_matrix(w: Tensor) -> Tensor:
    """Matrices of the cross product with vectors. [F, 3] -> [F, 3, 3]"""
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def _turn(gradient: Tensor) -> Tensor:
    """Rotation close to a gradient near the identity; exact for rotations by less than half a turn. [n, 4]"""
    g = gradient
    trace = g[:, 0, 0] + g[:, 1, 1] + g[:, 2, 2]
    parts = [1 + trace, g[:, 2, 1] - g[:, 1, 2], g[:, 0, 2] - g[:, 2, 0], g[:, 1, 0] - g[:, 0, 1]]
    quat = torch.stack(parts, 1)
    return quat / quat.norm(dim=1, keepdim=True).clamp(min=1e-8)
