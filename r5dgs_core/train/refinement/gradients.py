"""Gradients of a loss with respect to corrections of cameras, from those of the splats."""

from __future__ import annotations

import math

import numpy as np
import torch

from ..representations.fused_posing import PosedSplats
from ..train_views import TrainView


def camera_gradient(view: TrainView, splats: PosedSplats, shift: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the gradient of a loss with respect to pose correction and log focal length of the camera.

    Sizes of the Gaussians in the image change with the focal length as with their own sizes.

    Args:
        view: The view as drawn.
        splats: Its splats, with gradients of means, quats and scales.
        shift: Shift of the camera's present correction, the fixed point of its rotation. [3]

    Returns:
        Gradient of rotation and shift in the camera's axes [6], and that of the log focal length.
    """
    like = splats.means
    assert like.grad is not None
    camera = torch.from_numpy(view.camera.T_cam_world).to(like)
    rotation = camera[:3, :3]
    p, by_p = like @ rotation.T + camera[:3, 3], like.grad @ rotation.T
    by_shift = by_p.sum(0, dtype=torch.float64)
    lever = p - torch.from_numpy(np.asarray(shift)).to(like)
    by_turn = torch.linalg.cross(lever, by_p).sum(0, dtype=torch.float64)
    focal = (p[:, :2] * by_p[:, :2]).sum(dtype=torch.float64)
    if splats.quats.grad is not None:
        w, v, gw, gv = splats.quats[:, :1], splats.quats[:, 1:], splats.quats.grad[:, :1], splats.quats.grad[:, 1:]
        spun = 0.5 * (w * gv - gw * v + torch.linalg.cross(v, gv)).sum(0, dtype=torch.float64)
        by_turn = by_turn + rotation.to(torch.float64) @ spun
    if splats.scales.grad is not None:
        focal = focal + (splats.scales * splats.scales.grad).sum(dtype=torch.float64)
    numbers = torch.cat([by_turn, by_shift, focal[None]]).cpu().numpy()
    return numbers[:6], float(numbers[6])


def time_gradient(splats: PosedSplats, before: PosedSplats, after: PosedSplats) -> float:
    """Return the change of the loss from the splats of an earlier to those of a later time, to first order."""
    total = 0.0
    for name in ("means", "quats"):
        gradient = getattr(splats, name).grad
        if gradient is not None:
            total += float((gradient * (getattr(after, name) - getattr(before, name))).sum(dtype=torch.float64))
    return total if math.isfinite(total) else 0.0
