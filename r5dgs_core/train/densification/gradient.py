"""Densification by screen-space gradients: `TopGradientShare` and `AdaptiveDensityControl` (3DGS).

Source: 3D Gaussian Splatting (Kerbl et al. 2023), section 5.2.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ...config.sections.densification import DensifyDefaultSection, DensifySection
from ...model.gaussians import Gaussians
from ...raster import RasterStats
from ...scene.cameras import Camera
from . import densifier
from .densifier import Conditions, ScreenGradients


class _Gradients:
    """Base of both strategies: accumulates screen-space gradients since the last round.

    Args:
        conditions: Properties of the run.
        count: Number of Gaussians.
        device: Their device.
    """

    def __init__(self, conditions: Conditions, count: int, device: torch.device | str = "cpu"):
        self.conditions = conditions
        self.gradients = ScreenGradients(count, device)

    def penalty(self, gaussians: Gaussians) -> Tensor | None:
        """See `densifier.Strategy.penalty`."""
        return None

    def observe(self, stats: RasterStats, camera: Camera) -> None:
        """See `densifier.Strategy.observe`."""
        self.gradients.observe(stats, camera)

    def tensors(self) -> dict[str, Tensor]:
        """See `densifier.Strategy.tensors`."""
        return self.gradients.tensors()

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """See `densifier.Strategy.restore`."""
        self.gradients = ScreenGradients.of(tensors)


class TopGradientShare(_Gradients):
    """Default strategy: the Gaussians with the largest gradients grow, up to a share of all per round; no resets.

    A small weight on the mean opacity fades Gaussians that no image needs. Otherwise Gaussians that no camera sees, or
    that repeat the sky in front of it, would keep their random initial state and be visible in other views.

    Args:
        section: Thresholds.
        conditions: Properties of the run.
        count: Number of Gaussians.
        device: Their device.
    """

    def __init__(self, section: DensifySection, conditions: Conditions, count: int, device: torch.device | str = "cpu"):
        super().__init__(conditions, count, device)
        self.section = section
        self.width_limit = section.prune_width * conditions.image_width * conditions.pixel_size

    def penalty(self, gaussians: Gaussians) -> Tensor | None:
        """Return the weighted mean opacity, or None if its weight is 0."""
        if self.section.opacity <= 0 or len(gaussians) == 0:
            return None
        return self.section.opacity * torch.sigmoid(gaussians.params["opacity_logits"]).mean()

    def after_step(
        self, gaussians: Gaussians, optimizer: torch.optim.Optimizer, iteration: int, means_rate: float
    ) -> None:
        """See `densifier.Strategy.after_step`."""
        section = self.section
        if iteration % section.every == 0 and section.start <= iteration <= section.stop * self.conditions.iterations:
            self.round(gaussians, optimizer)

    @torch.no_grad()
    def round(self, gaussians: Gaussians, optimizer: torch.optim.Optimizer) -> None:
        """Grow Gaussians with large gradients, then prune; Gaussians and optimizer are changed in place."""
        section, conditions, n = self.section, self.conditions, len(gaussians)
        score = self.gradients.mean()
        room = max(0, conditions.cap - n)
        count = int(min(section.share * n, room, int((score > section.gradient).sum())))
        remove = torch.zeros_like(score, dtype=torch.bool)
        if count > 0:
            chosen = score.topk(count).indices
            split = gaussians.log_scales[chosen].exp().amax(1) > section.split_pixels * conditions.pixel_size
            remove = densifier.grow(gaussians, optimizer, chosen, split, conditions.generator)
        remove |= torch.sigmoid(gaussians.opacity_logits) < section.prune_opacity
        remove |= gaussians.log_scales.exp().amax(1) > self.width_limit
        remove |= densifier.floaters(gaussians, conditions.eyes, section.prune_near)
        gaussians.keep(optimizer, ~remove)
        self.gradients = self.gradients.restarted(len(gaussians))


class AdaptiveDensityControl(_Gradients):
    """Default strategy of 3DGS (adaptive density control with opacity resets), with a hard cap.

    With a white background, opacities are also reset when growth begins, so that white Gaussians in front of it fade.

    Args:
        section: Thresholds.
        conditions: Properties of the run.
        count: Number of Gaussians.
        device: Their device.
    """

    def __init__(
        self, section: DensifyDefaultSection, conditions: Conditions, count: int, device: torch.device | str = "cpu"
    ):
        super().__init__(conditions, count, device)
        self.section = section

    def after_step(
        self, gaussians: Gaussians, optimizer: torch.optim.Optimizer, iteration: int, means_rate: float
    ) -> None:
        """See `densifier.Strategy.after_step`."""
        section = self.section
        if iteration >= section.stop * self.conditions.iterations:
            return
        if iteration > section.start and iteration % section.every == 0:
            self.round(gaussians, optimizer, sizes=section.reset_every > 0 and iteration > section.reset_every)
        begins = self.conditions.white and iteration == section.start
        if section.reset_every > 0 and (begins or iteration % section.reset_every == 0):
            self.reset(gaussians, optimizer)

    @torch.no_grad()
    def round(self, gaussians: Gaussians, optimizer: torch.optim.Optimizer, *, sizes: bool) -> None:
        """Clone and split all Gaussians with a gradient above the threshold, largest first, then prune.

        Args:
            gaussians: Changed in place.
            optimizer: Changed in place, too.
            sizes: True to also remove large Gaussians; False until the first reset of the opacities.
        """
        section, conditions, n = self.section, self.conditions, len(gaussians)
        score, radii = self.gradients.mean(), self.gradients.radii
        count = min(max(0, conditions.cap - n), int((score >= section.gradient).sum()))
        remove = torch.zeros_like(score, dtype=torch.bool)
        if count > 0:
            chosen = score.topk(count).indices
            split = gaussians.log_scales[chosen].exp().amax(1) > section.percent_dense * conditions.extent
            remove = densifier.grow(gaussians, optimizer, chosen, split, conditions.generator)
        remove |= torch.sigmoid(gaussians.opacity_logits) < section.prune_opacity
        if sizes:
            remove |= gaussians.log_scales.exp().amax(1) > section.prune_extent * conditions.extent
            remove[:n] |= radii > section.prune_radius
        gaussians.keep(optimizer, ~remove)
        self.gradients = self.gradients.restarted(len(gaussians))

    @torch.no_grad()
    def reset(self, gaussians: Gaussians, optimizer: torch.optim.Optimizer) -> None:
        """Lower all opacities to ``reset_opacity``; only those that the images need recover."""
        limit = self.section.reset_opacity
        gaussians.params["opacity_logits"].clamp_(max=math.log(limit / (1 - limit)))
        densifier.reset_moments(gaussians, optimizer, ("opacity_logits",), None)
