"""Tracks: one SE(3) motion per body, as knots at the observed times.

Notation: G motion groups, S knots. Group g moves a canonical point x to c_g + R_g(t) (x - c_g) + d_g(t) with a fixed
centre c_g. Group 0 is pinned. A shadow group has d = A d_caster with A = I - n n^T + s n^T (n normal of the support
plane, s learned slope along it), and no rotation.

A knot's rotation is exp(rotvec) * base. The optimizer updates ``rotvecs``; `rebase` periodically folds them into
``base_quats``. An object may thus rotate by any angle while the exponential stays far from its singularity.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..motion import cubic_curves, rotations
from .group_poses import GroupPoses


class Tracks:
    """Poses of the bodies at the knots, and of the shadows that follow them.

    Args:
        times: Knots, increasing. [S]
        centers: Fixed centres of the bodies, row 0 for the pinned group. [B, 3]
        translations: Displacements at the knots. [B, S, 3]
        base_quats: Rotations at the knots, unit wxyz. [B, S, 4]
        casters: Body that each shadow group follows; shadow groups are numbered from B on. [W]
        plane_normal: Unit normal of the support plane, or None without shadows. [3]
        owners: Class of each body; None if body k is that of class k. Parts of an object have its class. [B]
    """

    def __init__(
        self,
        times: np.ndarray,
        centers: Tensor,
        translations: Tensor,
        base_quats: Tensor,
        casters: Tensor | None = None,
        plane_normal: Tensor | None = None,
        owners: Tensor | None = None,
    ):
        self.times = np.asarray(times, np.float64)
        self.centers = centers
        self.base_quats = base_quats
        self.casters = casters if casters is not None else torch.zeros(0, dtype=torch.int64, device=centers.device)
        self.plane_normal = plane_normal if plane_normal is not None else centers.new_tensor([0.0, 0.0, 1.0])
        self.owners = owners if owners is not None else torch.arange(len(centers), device=centers.device)
        self._spacings = torch.from_numpy(np.diff(self.times)).float().to(centers.device)
        self._moving = torch.ones(len(centers), 1, device=centers.device)
        self._moving[0] = 0.0
        self.params: dict[str, Tensor] = {
            "translations": translations.detach().requires_grad_(True),
            "rotvecs": torch.zeros_like(translations).requires_grad_(True),
            "slope": centers.new_zeros(3, dtype=torch.float32).requires_grad_(True),
        }

    def to(self, device: torch.device) -> Tracks:
        """Return the tracks on a device."""
        translations = self.params["translations"].detach()
        fixed = (self.centers, translations, self.base_quats, self.casters, self.plane_normal, self.owners)
        moved = Tracks(self.times, *(tensor.to(device) for tensor in fixed))
        for name, parameter in self.params.items():
            moved.params[name] = parameter.detach().to(device).requires_grad_(True)
        return moved

    @property
    def bodies(self) -> int:
        """Number of bodies, including the pinned group."""
        return len(self.centers)

    @property
    def groups(self) -> int:
        """Number of motion groups, including shadows."""
        return self.bodies + len(self.casters)

    def group_centers(self) -> Tensor:
        """Centres of all groups; a shadow has its caster's. [G, 3]"""
        return torch.cat([self.centers, self.centers[self.casters]])

    def follow_matrix(self) -> Tensor:
        """Linear map from a caster's displacement to its shadow's. [3, 3]"""
        n = self.plane_normal
        slope = self.params["slope"]
        in_plane = slope - (slope @ n) * n
        return torch.eye(3, device=n.device) - torch.outer(n, n) + torch.outer(in_plane, n)

    def knot_weights(self, t: float) -> dict[int, float]:
        """Weights of the knots at a time: 1 at a knot, constant outside the range, else those of playback's curve.

        The curve, a cubic Hermite per component with slopes from neighbouring knots, is linear in the knots' values.
        """
        k = int(np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.times) - 1))
        near = k if k + 1 == len(self.times) or t - self.times[k] <= self.times[k + 1] - t else k + 1
        span = self.times[min(k + 1, len(self.times) - 1)] - self.times[k]
        if abs(t - self.times[near]) <= 1e-9 * max(span, 1.0) or not self.times[0] < t < self.times[-1]:
            return {near: 1.0}
        window = np.arange(max(k - 1, 0), min(k + 3, len(self.times)))
        one = np.eye(len(window))
        at = k - window[0]
        slopes = cubic_curves.slopes(self.times[window], one)
        weights = cubic_curves.hermite(
            one[at], one[at + 1], slopes[at], slopes[at + 1], span, np.asarray((t - self.times[k]) / span)
        )
        return {int(s): float(w) for s, w in zip(window, weights, strict=True) if w != 0.0}

    def poses(self, t: float) -> GroupPoses:
        """Return the poses of all groups at a time, differentiable."""
        return self.poses_of(self.knot_weights(t))

    def poses_of(self, weights: dict[int, float] | Tensor) -> GroupPoses:
        """Return the poses of all groups, differentiable; weights as of `knot_weights`, or one knot, int64 [1]."""
        quats, displacements = self._knot(weights if isinstance(weights, Tensor) else next(iter(weights)))
        if not isinstance(weights, Tensor) and len(weights) > 1:
            mixed, moved, previous = torch.zeros_like(quats), torch.zeros_like(displacements), quats
            for s, weight in weights.items():
                quats, displacements = self._knot(s)
                previous = torch.where((quats * previous).sum(-1, keepdim=True) < 0, -quats, quats)
                mixed, moved = mixed + weight * previous, moved + weight * displacements
            quats = mixed / mixed.norm(dim=-1, keepdim=True)
            displacements = moved
        if len(self.casters):
            followed = displacements[self.casters] @ self.follow_matrix().T
            still = quats.new_zeros(len(self.casters), 4)
            still[:, 0] = 1.0
            quats = torch.cat([quats, still])
            displacements = torch.cat([displacements, followed])
        return GroupPoses(quats, rotations.quats_to_rotmats(quats), displacements)

    def _knot(self, s: int | Tensor) -> tuple[Tensor, Tensor]:
        three = (self.params["rotvecs"], self.base_quats, self.params["translations"])
        rotvecs, base, moves = (x.index_select(1, s)[:, 0] if isinstance(s, Tensor) else x[:, s] for x in three)
        quats = rotations.multiply(rotations.rotvecs_to_quats(rotvecs * self._moving), base)
        return quats, moves * self._moving

    def knot_quats(self) -> Tensor:
        """Rotations of the bodies at all knots. [B, S, 4]"""
        return rotations.multiply(rotations.rotvecs_to_quats(self.params["rotvecs"]), self.base_quats)

    @torch.no_grad()
    def rebase(self) -> None:
        """Fold the learned rotation vectors into the base rotations and reset them to zero."""
        self.base_quats.copy_(rotations.normalize(self.knot_quats()).detach())
        self.params["rotvecs"].zero_()

    def roughness(
        self,
        entered: tuple[int, int] | None = None,
        shift_stiffness: Tensor | None = None,
        turn_stiffness: Tensor | None = None,
    ) -> Tensor:
        """Mean squared second difference of displacements and rotations over the knots (0 for steady motion).

        Knots may be unevenly spaced: divided differences are scaled by the squared mean spacing, so that even spacing
        gives plain second differences.

        Args:
            entered: First and last knot to include; None for all. The mean is always over all knots.
            shift_stiffness: Weight of each class's displacement at each knot; None for 1. [C - 1, S]
            turn_stiffness: Weight matrix of its rotation, world axes; None for the identity. [C - 1, S, 3, 3]
        """
        first, last = (0, len(self.times) - 1) if entered is None else entered
        if last - first < 2 or self.bodies < 2:
            return self.centers.new_zeros(())
        step = self._spacings
        mean_step = step.mean()
        step = step[first:last][None, :, None]
        here = slice(first, last + 1)
        quats = rotations.multiply(
            rotations.rotvecs_to_quats(self.params["rotvecs"][1:, here]), self.base_quats[1:, here]
        )
        turns = rotations.quats_to_rotvecs(rotations.multiply(quats[:, 1:], rotations.conjugate(quats[:, :-1])))
        shifts = self.params["translations"][1:, here]
        squares = []
        for change, stiffness in ((shifts[:, 1:] - shifts[:, :-1], shift_stiffness), (turns, turn_stiffness)):
            rate = change / step
            second = 2 * (rate[:, 1:] - rate[:, :-1]) / (step[:, 1:] + step[:, :-1]) * mean_step**2
            if stiffness is None:
                weighted = second
            else:
                stiffness = stiffness[self.owners[1:] - 1][:, here]
                middle = (stiffness[:, :-2] + stiffness[:, 1:-1] + stiffness[:, 2:]) / 3
                flat = middle.dim() == 2
                weighted = middle[..., None] * second if flat else (middle @ second[..., None])[..., 0]
            squares.append((second * weighted).sum())
        return sum(squares, step.new_zeros(())) / (3 * (self.bodies - 1) * (len(self.times) - 2))
