"""Densification: Gaussians with large screen gradients are cloned or split, faint and oversized ones removed.

Gradients are measured per half image width and sizes in pixels, so that the thresholds hold at any resolution.

Source: 3D Gaussian Splatting (Kerbl et al. 2023), section 5.2, with a bound on the share that grows in a round and
without opacity resets.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..model.gaussians import Gaussians
from ..motion import rotations
from ..scene.cameras import Camera
from .config import DensifySection


class ScreenGradients:
    """Running mean of the screen gradient of each Gaussian over the views that show it."""

    def __init__(self, count: int):
        self.total = torch.zeros(count)
        self.views = torch.zeros(count)

    def add(self, grad_norm: Tensor, visible: Tensor) -> None:
        """Add one view: gradient norms per half image width [N] and visibility [N]."""
        self.total += torch.where(visible, grad_norm, 0.0)
        self.views += visible

    def mean(self) -> Tensor:
        """Mean screen gradient. [N]"""
        return self.total / self.views.clamp(min=1)


def floaters(gaussians: Gaussians, eyes: Sequence[Camera], distance: float) -> Tensor:
    """Background Gaussians close before a camera that no second camera sees: their depth is not determined.

    Args:
        gaussians: The Gaussians; those of group 0 are looked at.
        eyes: The distinct training cameras; with fewer than three there is no second opinion.
        distance: What is close, in normalised units.

    Returns:
        Which ones they are. [N] bool
    """
    means = gaussians.params["means"].detach()
    pinned = gaussians.motion_ids == 0
    if len(eyes) < 3 or distance <= 0:
        return torch.zeros_like(pinned)
    seen = torch.zeros(len(means))
    near = torch.zeros_like(pinned)
    for camera in eyes:
        T = torch.from_numpy(camera.T_cam_world).float()
        k = camera.intrinsics
        p_cam = means @ T[:3, :3].T + T[:3, 3]
        z = p_cam[:, 2].clamp(min=1e-6)
        u = k[0, 0] * p_cam[:, 0] / z + k[0, 2]
        v = k[1, 1] * p_cam[:, 1] / z + k[1, 2]
        inside = (p_cam[:, 2] > 0) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)
        seen += inside
        near |= p_cam.norm(dim=1) < distance
    return pinned & near & (seen < 2)


def densify(
    gaussians: Gaussians,
    optimizer: torch.optim.Optimizer,
    gradients: ScreenGradients,
    section: DensifySection,
    cap: int,
    pixel_size: float,
    width_limit: float,
    eyes: Sequence[Camera],
    generator: torch.Generator,
) -> None:
    """One round: grow where the image asks for it, then prune.

    Args:
        gaussians: Changed in place, optimizer state included.
        optimizer: The optimizer that holds their parameters.
        gradients: Screen gradients since the last round.
        section: Thresholds.
        cap: Largest number of Gaussians.
        pixel_size: Typical size of a pixel at the objects, normalised units.
        width_limit: Standard deviation above which a Gaussian is removed, normalised units.
        eyes: The distinct training cameras.
        generator: Source of the draws.
    """
    n = len(gaussians)
    room = cap - n
    with torch.no_grad():
        score = gradients.mean()
        grow = int(min(section.share * n, room, int((score > section.gradient).sum())))
        remove = torch.zeros(n, dtype=torch.bool)
        if grow > 0:
            chosen = score.topk(grow).indices
            big = gaussians.log_scales[chosen].exp().amax(1) > section.split_pixels * pixel_size
            cloned, split = chosen[~big], chosen[big]
            remove[split] = True
            source = torch.cat([cloned, split, split])
            new = {name: tensor[source].clone() for name, tensor in gaussians.params.items()}
            first = len(cloned)
            scales = new["log_scales"][first:].exp()
            quats = rotations.normalize(new["quats"][first:])
            noise = torch.randn(scales.shape, generator=generator) * scales
            new["means"][first:] += rotations.rotate(quats, noise)
            new["log_scales"][first:] -= torch.log(torch.tensor(1.6))
            gaussians.extend(optimizer, new, gaussians.motion_ids[source])
            remove = torch.cat([remove, torch.zeros(len(source), dtype=torch.bool)])
        faint = torch.sigmoid(gaussians.opacity_logits) < section.prune_opacity
        wide = gaussians.log_scales.exp().amax(1) > width_limit
        gaussians.keep(optimizer, ~(remove | faint | wide | floaters(gaussians, eyes, section.prune_near)))
