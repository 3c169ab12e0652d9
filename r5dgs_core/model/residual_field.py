"""A residual field: how bodies that bend or breathe differ from their rigid track, by nodes spread over each body.

Notation: Q nodes of all flexible bodies together, S knots, n members of a body. Node j at the canonical place p_j with
the length h of its body carries at each knot an offset d_j and three rows l_j, the change of the offset per length h
along each axis. A member at x, with normalised weights w_j(x) that fall off over the spacing of the nodes, gets

    offset o(x) = sum_j w_j (d_j + l_j^T (x - p_j) / h),    gradient F(x) = I + sum_j w_j l_j^T / h

F turns the Gaussian and stretches its axes. What is left of a rigid motion in o is taken out, to first order: it
belongs to the track. Between knots values follow the curve of the tracks.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..motion import rotations


@dataclass(frozen=True)
class Change:
    """What a field does to the members of its bodies, in canonical coordinates.

    Attributes:
        rows: The members among all Gaussians. [n] int64
        offsets: Added to the centres. [n, 3]
        quats: Rotations that go before those of the Gaussians, unit wxyz. [n, 4]
        log_scales: Added to the log scales. [n, 3]
    """

    rows: Tensor
    offsets: Tensor
    quats: Tensor
    log_scales: Tensor


class ResidualField:
    """Nodes on the flexible bodies with their values at the knots; at zero it changes nothing.

    Args:
        nodes: Canonical places. [Q, 3]
        owners: Motion group of each node, in runs. [Q] int64
        values: d and the rows of l at the knots. [S, Q, 4, 3]
    """

    def __init__(self, nodes: Tensor, owners: Tensor, values: Tensor):
        self.nodes = nodes
        self.owners = owners
        self.values = values.detach().requires_grad_(True)
        self._runs: list[tuple[int, slice, float, float]] = []
        for body in owners.unique().tolist():
            at = torch.nonzero(owners == body)[:, 0]
            run = slice(int(at[0]), int(at[-1]) + 1)
            self._runs.append((body, run, *_lengths(nodes[run])))

    @property
    def bodies(self) -> list[int]:
        """Motion groups that have nodes."""
        return [body for body, *_ in self._runs]

    def only(self, bodies: list[int]) -> ResidualField:
        """The field of some of its bodies."""
        kept = torch.isin(self.owners, torch.tensor(bodies, dtype=torch.int64))
        return ResidualField(self.nodes[kept], self.owners[kept], self.values.detach()[:, kept].clone())

    def change(
        self,
        means: Tensor,
        quats: Tensor,
        opacities: Tensor,
        motion_ids: Tensor,
        weights: dict[int, float],
    ) -> Change:
        """What happens to the members at a time; differentiable in the values and ``quats``.

        Args:
            means: Canonical centres of all Gaussians. [N, 3]
            quats: Their rotations wxyz, any positive norm. [N, 4]
            opacities: Weights of the members in the rigid motion that is taken out. [N]
            motion_ids: Their motion groups. [N] int64
            weights: Of the knots at that time.
        """
        means, opacities = means.detach(), opacities.detach()
        mixed = torch.zeros_like(self.values[0])
        for s, weight in weights.items():
            mixed = mixed + weight * self.values[s]
        rows, offsets, gradients = [], [], []
        for body, run, length, spacing in self._runs:
            members = torch.nonzero(motion_ids == body)[:, 0]
            if len(members) == 0:
                continue
            x = means[members]
            offset, gradient = _blend(x, self.nodes[run], mixed[run], length, spacing)
            shift, spin = _rigid_part(x, offset, opacities[members])
            middle = x - _mean(x, opacities[members])
            offsets.append(offset - shift - torch.linalg.cross(spin.expand_as(middle), middle))
            gradients.append(gradient - _cross_matrix(spin))
            rows.append(members)
        if not rows:
            none = means.new_zeros(0, 3)
            return Change(motion_ids.new_zeros(0), none, means.new_zeros(0, 4), none)
        where, gradient = torch.cat(rows), torch.cat(gradients) + torch.eye(3, dtype=means.dtype)
        axes = rotations.quats_to_rotmats(rotations.normalize(quats[where]))
        stretched = gradient @ axes
        growth = 0.5 * torch.log((stretched**2).sum(-2).clamp(min=1e-4))
        return Change(where, torch.cat(offsets), _turn(gradient), growth)

    def penalty(self, size: float, roughness: float) -> Tensor:
        """Weighted sum of the mean squared value and of its second difference over the knots, per length of the body.

        Args:
            size: Weight of the values.
            roughness: Weight of their second differences.
        """
        total = self.values.new_zeros(())
        second = self.values[2:] - 2 * self.values[1:-1] + self.values[:-2]
        for _, run, length, _ in self._runs:
            total = total + size * ((self.values[:, run] / length) ** 2).mean()
            if len(second):
                total = total + roughness * ((second[:, run] / length) ** 2).mean()
        return total / max(1, len(self._runs))


def spread(means: Tensor, motion_ids: Tensor, opacities: Tensor, bodies: list[int], count: int, knots: int):
    """A field at zero: nodes on the members of bodies, each as far from the others as can be.

    Args:
        means: Canonical centres of all Gaussians. [N, 3]
        motion_ids: Their motion groups. [N] int64
        opacities: Members fainter than 0.3 carry no node where others do. [N]
        bodies: Motion groups that get nodes; those without members get none.
        count: Nodes of each body, at most.
        knots: Number of knots S.
    """
    nodes, owners = [means.new_zeros(0, 3)], [torch.zeros(0, dtype=torch.int64)]
    for body in bodies:
        members = motion_ids == body
        seen = members & (opacities > 0.3)
        points = means.detach()[seen if seen.any() else members]
        if len(points) == 0:
            continue
        middle = points.median(0).values
        reach = (points - middle).norm(dim=1)
        points = points[reach <= 1.5 * reach.quantile(0.9)]  # strays would take nodes away from the body
        chosen = _far_apart(points, middle, min(count, len(points)))
        nodes.append(points[chosen])
        owners.append(torch.full((len(chosen),), body, dtype=torch.int64))
    place = torch.cat(nodes)
    return ResidualField(place, torch.cat(owners), means.new_zeros(knots, len(place), 4, 3))


def _far_apart(points: Tensor, start: Tensor, count: int) -> Tensor:
    """Indices of ``count`` points, each the farthest from those before it; the first is farthest from ``start``."""
    chosen = [int((points - start).norm(dim=1).argmax())]
    distance = (points - points[chosen[0]]).norm(dim=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (points - points[chosen[-1]]).norm(dim=1))
    return torch.tensor(chosen)


def _lengths(nodes: Tensor) -> tuple[float, float]:
    """Length of a body (root mean square distance from the middle) and spacing of its nodes (mean nearest distance)."""
    length = float((nodes - nodes.mean(0)).pow(2).sum(1).mean().sqrt())
    if len(nodes) < 2 or length <= 0:
        return max(length, 1e-3), 1.0
    distance = torch.cdist(nodes, nodes)
    distance.fill_diagonal_(torch.inf)
    return length, max(float(distance.min(1).values.mean()), 1e-6)


def _blend(x: Tensor, nodes: Tensor, values: Tensor, length: float, spacing: float) -> tuple[Tensor, Tensor]:
    """Offsets [n, 3] and gradients, columns by the axis of x, [n, 3, 3] of members at x."""
    squared = (x**2).sum(1, keepdim=True) - 2 * x @ nodes.T + (nodes**2).sum(1)
    weights = torch.softmax(-squared / (2 * spacing**2), dim=1)
    slopes = values[:, 1:] / length  # row: axis of x, column: component of the offset
    base = values[:, 0] - (nodes[:, None] @ slopes)[:, 0]
    flat = weights @ torch.cat([base, slopes.flatten(1)], 1)
    gradient = flat[:, 3:].reshape(-1, 3, 3)
    return flat[:, :3] + (x[:, None] @ gradient)[:, 0], gradient.transpose(1, 2)


def _mean(x: Tensor, weights: Tensor) -> Tensor:
    return (weights[:, None] * x).sum(0) / weights.sum().clamp(min=1e-9)


def _rigid_part(x: Tensor, offsets: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Mean offset [3] and the small rotation [3] about the mean of x that explains the offsets best, weighted."""
    middle = x - _mean(x, weights)
    shift = _mean(offsets, weights)
    squares = (weights[:, None, None] * middle[:, :, None] * middle[:, None, :]).sum(0)
    one = torch.eye(3, dtype=x.dtype)
    inertia = one * squares.trace() - squares
    inertia = inertia + 1e-6 * squares.trace().clamp(min=1e-12) * one  # a line does not tell its spin
    moment = (weights[:, None] * torch.linalg.cross(middle, offsets - shift)).sum(0)
    return shift, torch.linalg.solve(inertia, moment)


def _cross_matrix(w: Tensor) -> Tensor:
    zero = w.new_zeros(())
    return torch.stack([zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero]).reshape(3, 3)


def _turn(gradient: Tensor) -> Tensor:
    """Rotation next to a gradient near the identity; exact where it is a rotation by less than half a turn. [n, 4]"""
    g = gradient
    trace = g[:, 0, 0] + g[:, 1, 1] + g[:, 2, 2]
    parts = [1 + trace, g[:, 2, 1] - g[:, 1, 2], g[:, 0, 2] - g[:, 2, 0], g[:, 1, 0] - g[:, 0, 1]]
    quat = torch.stack(parts, 1)
    return quat / quat.norm(dim=1, keepdim=True).clamp(min=1e-8)
