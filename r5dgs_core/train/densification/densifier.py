"""Densification: interface of the strategies, and operations that they share.

A strategy observes each step, may add a penalty to the loss, and after each step may change the Gaussians in place,
including their optimizer state. Named tensors hold the state that its next step depends on, so that a resumed run gives
the same numbers. Sizes are in normalised units and gradients per half image width, so that thresholds hold at any
resolution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from ...config.config import Config
from ...model.gaussians import Gaussians
from ...motion import rotations
from ...raster import RasterStats, arrays
from ...scene.cameras import Camera
from ..normalization import TARGET_DISTANCE

SPLIT_SHRINK = 1.6  # the two halves of a split Gaussian are smaller by this factor (0.8 N of 3DGS, N = 2)


@dataclass(frozen=True)
class Conditions:
    """Properties of the run that a strategy depends on.

    Attributes:
        cap: Maximum number of Gaussians, from the start and after each step.
        iterations: Steps of the whole run.
        pixel_size: Typical size of a pixel at the objects, normalised units.
        image_width: Typical width of an image, px.
        extent: Radius of the cameras, normalised units (`extent_of`).
        eyes: Distinct training cameras, in normalised coordinates.
        generator: Random generator; its state belongs to the run.
        white: True if the background is fixed to white.
    """

    cap: int
    iterations: int
    pixel_size: float
    image_width: float
    extent: float
    eyes: Sequence[Camera]
    generator: torch.Generator
    white: bool = False


def conditions(
    config: Config,
    cameras: Sequence[Camera],
    distinct: Sequence[Camera],
    count: int,
    generator: torch.Generator,
    white: bool,
) -> Conditions:
    """Return the properties of a run.

    Args:
        config: Its configuration.
        cameras: Camera of each training view, in normalised coordinates.
        distinct: Distinct ones of these.
        count: Initial number of Gaussians.
        generator: Its random generator.
        white: True if its background is fixed to white.
    """
    sizes = [camera.width * camera.height for camera in cameras]
    focal = float(np.median([camera.intrinsics[0, 0] for camera in cameras]))
    return Conditions(
        cap=config.densify.max_gaussians or max(count, int(min(60000, 0.75 * np.median(sizes)))),
        iterations=config.train.iterations,
        pixel_size=TARGET_DISTANCE / focal,
        image_width=float(np.median([camera.width for camera in cameras])),
        extent=extent_of(distinct),
        eyes=distinct,
        generator=generator,
        white=white,
    )


class Strategy(Protocol):
    """Interface of densification strategies."""

    def penalty(self, gaussians: Gaussians) -> Tensor | None:
        """Return a term for the loss of the current step, or None."""
        ...

    def observe(self, stats: RasterStats, camera: Camera) -> None:
        """Record the statistics of a step, after its backward pass."""
        ...

    def after_step(
        self, gaussians: Gaussians, optimizer: torch.optim.Optimizer, iteration: int, means_rate: float
    ) -> None:
        """Change the Gaussians after ``iteration`` steps; ``means_rate`` is the learning rate of the centres."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """Return the state that the next step depends on, by name (``gradients.NAME``)."""
        ...

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state from `tensors`."""
        ...


class ScreenGradients:
    """Mean screen-space gradient of each Gaussian over the views that show it, and its largest radius, px."""

    def __init__(self, count: int, device: torch.device | str = "cpu"):
        self.total = torch.zeros(count, device=device)
        self.views = torch.zeros(count, device=device)
        self.radii = torch.zeros(count, device=device)

    def restarted(self, count: int) -> ScreenGradients:
        """Return statistics without a view: these, if the number of Gaussians is the same, or new ones."""
        if count != len(self.total):
            return ScreenGradients(count, self.total.device)
        for tensor in (self.total, self.views, self.radii):
            tensor.zero_()
        return self

    def add(self, grad_norm: Tensor, visible: Tensor, radii: Tensor | None = None) -> None:
        """Add one view: gradient norms per half image width [N], visibility [N] and radii in px [N]."""
        self.total += torch.where(visible, grad_norm, 0.0)
        self.views += visible
        if radii is not None:
            torch.maximum(self.radii, torch.where(visible, radii.to(self.radii.dtype), 0.0), out=self.radii)

    def observe(self, stats: RasterStats, camera: Camera) -> None:
        """Add the view of a training step."""
        if stats.grad_norm is not None and stats.visible is not None:
            self.add(0.5 * camera.width * stats.grad_norm, stats.visible, stats.radii)

    def mean(self) -> Tensor:
        """Mean screen-space gradient. [N]"""
        return self.total / self.views.clamp(min=1)

    def tensors(self) -> dict[str, Tensor]:
        """Return the state by ``gradients.NAME``."""
        return {f"gradients.{name}": getattr(self, name) for name in ("total", "views", "radii")}

    @classmethod
    def of(cls, tensors: dict[str, Tensor]) -> ScreenGradients:
        """Create from `tensors`; radii, which earlier versions did not store, default to 0."""
        made = cls(len(tensors["gradients.total"]), tensors["gradients.total"].device)
        for name in ("total", "views", "radii"):
            setattr(made, name, tensors.get(f"gradients.{name}", getattr(made, name)))
        return made


def extent_of(cameras: Sequence[Camera]) -> float:
    """Return the extent of 3DGS: 1.1 times the largest distance of a camera from the mean of all, in their units."""
    centers = torch.stack([torch.from_numpy(camera.center) for camera in cameras])
    return 1.1 * float((centers - centers.mean(0)).norm(dim=1).max())


@torch.no_grad()
def grow(
    gaussians: Gaussians, optimizer: torch.optim.Optimizer, chosen: Tensor, split: Tensor, generator: torch.Generator
) -> Tensor:
    """Clone some Gaussians and split others. Once the caller has removed the split ones, each chosen Gaussian has added
    one to the total.

    Args:
        gaussians: Changed in place, including optimizer state; new ones are appended and inherit the motion group.
        optimizer: Optimizer of their parameters.
        chosen: Rows that grow. [G]
        split: True for rows to split: two smaller Gaussians drawn from the Gaussian replace it. [G] bool
        generator: Random generator.

    Returns:
        Mask of the split Gaussians, which the caller must remove, over all Gaussians after growing. [N] bool

    Source: 3DGS (Kerbl et al. 2023), section 5.2.
    """
    n = len(gaussians)
    chosen = chosen[torch.argsort(split.byte(), stable=True)]
    cloned, halved = chosen.tensor_split([len(chosen) - int(split.sum())])
    source = torch.cat([cloned, halved, halved])
    new = {name: tensor[source].clone() for name, tensor in gaussians.params.items()}
    first = len(cloned)
    scales = new["log_scales"][first:].exp()
    quats = rotations.normalize(new["quats"][first:])
    noise = torch.randn(scales.shape, generator=generator).to(scales.device, non_blocking=True) * scales
    new["means"][first:] += rotations.rotate(quats, noise)
    new["log_scales"][first:] -= torch.log(torch.tensor(SPLIT_SHRINK))
    gaussians.extend(optimizer, new, gaussians.motion_ids[source])
    remove = split.new_zeros(n + len(source), dtype=torch.bool)
    remove[halved] = True
    return remove


def reset_moments(
    gaussians: Gaussians, optimizer: torch.optim.Optimizer, names: Sequence[str], rows: Tensor | None
) -> None:
    """Reset the optimizer's moments of some parameters to zero, for some rows or for all (None)."""
    for name in names:
        state = optimizer.state.get(gaussians.params[name], {})
        for key in ("exp_avg", "exp_avg_sq"):
            if key in state:
                state[key][slice(None) if rows is None else rows] = 0.0


def seen_by_one_camera(gaussians: Gaussians, eyes: Sequence[Camera]) -> Tensor:
    """Mask of the background Gaussians in the image of at most one camera: no parallax determines their depth.

    Args:
        gaussians: The Gaussians; those of group 0 are the background.
        eyes: The distinct training cameras; with fewer than three, nothing is masked.

    Returns:
        Mask. [N] bool
    """
    means, background = gaussians.params["means"].detach(), gaussians.motion_ids == 0
    found = torch.zeros_like(background)
    if len(eyes) < 3:
        return found
    rows = _rows(background)
    count = torch.zeros_like(rows)
    for camera in eyes:
        k = camera.intrinsics
        p_cam = _in_camera(means[rows], camera)
        z = p_cam[:, 2].clamp(min=1e-6)
        u = k[0, 0] * p_cam[:, 0] / z + k[0, 2]
        v = k[1, 1] * p_cam[:, 1] / z + k[1, 2]
        count += (p_cam[:, 2] > 0) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)
        if arrays.takes_kernels(rows):
            rows, count = rows[count < 2], count[count < 2]
    found[rows] = count < 2
    return found & background


def floaters(gaussians: Gaussians, eyes: Sequence[Camera], distance: float) -> Tensor:
    """Mask of the Gaussians of `seen_by_one_camera` that lie close in front of a camera.

    Args:
        gaussians: The Gaussians.
        eyes: The distinct training cameras.
        distance: Maximum distance that counts as close, normalised units; nothing is masked if it is 0.

    Returns:
        Mask. [N] bool
    """
    if distance <= 0:
        return torch.zeros_like(gaussians.motion_ids, dtype=torch.bool)
    found, means = seen_by_one_camera(gaussians, eyes), gaussians.params["means"].detach()
    rows = _rows(found)
    near = torch.zeros_like(rows, dtype=torch.bool)
    for camera in eyes:
        near |= _in_camera(means[rows], camera).norm(dim=1) < distance
    found[rows] &= near
    return found


def _rows(mask: Tensor) -> Tensor:
    """Return the rows of a mask; on a GPU all rows, which it tests faster than it returns the number of some."""
    return torch.nonzero(mask)[:, 0] if arrays.takes_kernels(mask) else torch.arange(len(mask), device=mask.device)


def _in_camera(means: Tensor, camera: Camera) -> Tensor:
    """Return points [N, 3] in the frame of a camera. [N, 3]"""
    T = torch.from_numpy(camera.T_cam_world).float().to(means.device, non_blocking=True)
    return means @ T[:3, :3].T + T[:3, 3]
