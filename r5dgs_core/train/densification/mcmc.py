"""Densification as Markov Chain Monte Carlo: relocation of dead Gaussians, gradual growth and exploration by noise.

Notation: o opacity, s standard deviation, N the number of Gaussians that replace one.

Source: 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...config.sections.densification import DensifyMcmcSection
from ...model.gaussians import Gaussians
from ...motion import rotations
from ...raster import RasterStats, arrays
from ...scene.cameras import Camera
from . import densifier
from .densifier import Conditions

MAX_REPLACEMENTS = 51  # maximum number of Gaussians that replace one
GATE_SLOPE, GATE_OPACITY = 100.0, 0.005  # sigmoid gate of the noise over opacity


def divided(
    opacities: Tensor,  # [R]
    counts: Tensor,  # [R]
) -> tuple[Tensor, Tensor]:
    """Return opacity and size of N equal Gaussians that together look like one.

    At the centre they cover as much as the one, 1 - (1 - o')^N = o; and along any line through it the total is equal:
    the integral of 1 - (1 - o' g')^N equals that of o g, with g the falloff of the one and g' that of the N.

    Args:
        opacities: Opacity o of the one, in (0, 1). [R]
        counts: Number N of replacements, 1 to `MAX_REPLACEMENTS`. [R] integers

    Returns:
        Opacity o' of each of the N, and the factor on its standard deviations. [R], [R]

    Source: Kheradmand et al. 2024, Eq. 9; its double sum of binomials taken over i first, sum_i C(i-1, k) = C(N, k+1).
    """
    o = opacities.double()
    n = counts.double()
    each = -torch.expm1(torch.log1p(-o) / n)
    # sum over j = 1..N of C(N, j) (-1)^(j-1) o'^j / sqrt(j)
    total = torch.zeros_like(o)
    term = torch.ones_like(o)
    largest = MAX_REPLACEMENTS
    if arrays.takes_kernels(counts):  # elsewhere, reading the largest count takes longer than terms that are 0
        largest = int(counts.max()) if len(counts) else 0
    for j in range(1, largest + 1):
        term = term * (n - j + 1).clamp(min=0) / j * each
        total += (1 if j % 2 else -1) * term / j**0.5
    return each.to(opacities.dtype), (o / total).to(opacities.dtype)


class MCMC:
    """Strategy ``mcmc``: relocation, growth up to the cap, noise, and penalties that let Gaussians die.

    Args:
        section: Thresholds.
        conditions: Properties of the run.
    """

    def __init__(self, section: DensifyMcmcSection, conditions: Conditions):
        self.section = section
        self.conditions = conditions

    def penalty(self, gaussians: Gaussians) -> Tensor | None:
        """Return the weighted mean opacity and mean standard deviation."""
        if len(gaussians) == 0:
            return None
        opacity = self.section.opacity * torch.sigmoid(gaussians.params["opacity_logits"]).mean()
        return opacity + self.section.scale * gaussians.params["log_scales"].exp().mean()

    def observe(self, stats: RasterStats, camera: Camera) -> None:
        """Do nothing: the strategy depends on opacities only."""

    def tensors(self) -> dict[str, Tensor]:
        """Return no tensors: the strategy is stateless, and its generator belongs to the run."""
        return {}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Do nothing: the strategy is stateless."""

    @torch.no_grad()
    def after_step(
        self, gaussians: Gaussians, optimizer: torch.optim.Optimizer, iteration: int, means_rate: float
    ) -> None:
        """See `densifier.Strategy.after_step`."""
        section = self.section
        within = section.start < iteration < section.stop * self.conditions.iterations
        if within and iteration % section.every == 0:
            self.relocate(gaussians, optimizer)
            self.add(gaussians, optimizer)
        if section.noise > 0 and len(gaussians):
            self.shake(gaussians, section.noise * means_rate)

    @torch.no_grad()
    def relocate(self, gaussians: Gaussians, optimizer: torch.optim.Optimizer) -> None:
        """Move each dead Gaussian onto a live one drawn by opacity; both together replace the live one."""
        opacities = torch.sigmoid(gaussians.params["opacity_logits"])
        dead = opacities <= self.section.dead_opacity
        live = torch.where(dead, 0.0, opacities)
        count, sources = torch.stack([dead.sum(), (live > 0).sum()]).tolist()
        if count == 0 or sources == 0:
            return
        rows = torch.argsort((~dead).byte(), stable=True)[:count]
        source = self._draw(live, count)
        self._divide(gaussians, source)
        for tensor in gaussians.params.values():
            tensor[rows] = tensor[source]
        motion_ids = gaussians.motion_ids.clone()
        motion_ids[rows] = motion_ids[source]
        gaussians.motion_ids = motion_ids
        densifier.reset_moments(gaussians, optimizer, tuple(gaussians.params), torch.cat([rows, source]))

    @torch.no_grad()
    def add(self, gaussians: Gaussians, optimizer: torch.optim.Optimizer) -> None:
        """Add a share of new Gaussians, drawn by opacity, up to the cap."""
        n = len(gaussians)
        count = min(self.conditions.cap, int((1 + self.section.grow) * n)) - n
        opacities = torch.sigmoid(gaussians.params["opacity_logits"])
        if count > 0 and (opacities > 0).any():
            source = self._draw(opacities, count)
            self._divide(gaussians, source)
            densifier.reset_moments(gaussians, optimizer, tuple(gaussians.params), source)
            new = {name: tensor[source].clone() for name, tensor in gaussians.params.items()}
            gaussians.extend(optimizer, new, gaussians.motion_ids[source])

    @torch.no_grad()
    def shake(self, gaussians: Gaussians, size: float) -> None:
        """Add noise in the shape of the covariance to the centres; opaque Gaussians stay.

        Args:
            gaussians: Changed in place.
            size: Noise per variance, 1 / normalised units.

        Source: Kheradmand et al. 2024, Eq. 8 and 11.
        """
        params = gaussians.params
        opacities = torch.sigmoid(params["opacity_logits"])
        gate = torch.sigmoid(GATE_SLOPE * (GATE_OPACITY - opacities))
        draws = torch.randn(params["means"].shape, generator=self.conditions.generator)
        draws = draws.to(opacities.device, non_blocking=True)
        quats = rotations.normalize(params["quats"])
        own = rotations.rotate(rotations.conjugate(quats), draws)
        noise = rotations.rotate(quats, own * (2 * params["log_scales"]).exp())
        params["means"] += size * gate[:, None] * noise

    def _draw(self, weights: Tensor, count: int) -> Tensor:
        """Draw rows by weight, with replacement. [count]"""
        edges = weights.double().cumsum(0)
        draws = torch.rand(count, generator=self.conditions.generator, dtype=torch.float64)
        draws = draws.to(edges.device, non_blocking=True) * edges[-1]
        last = len(weights) - 1 - (weights > 0).flip(0).int().argmax()  # last row with a weight
        return torch.searchsorted(edges, draws, right=True).minimum(last)

    def _divide(self, gaussians: Gaussians, source: Tensor) -> None:
        """Set opacity and size of each drawn Gaussian so that it and its copies together look like the original."""
        opacities = torch.sigmoid(gaussians.params["opacity_logits"])
        times = torch.zeros_like(gaussians.motion_ids).index_add(0, source, torch.ones_like(source))
        drawn = times > 0
        each, factor = divided(opacities.clamp(max=1 - 1e-6), (times + 1).clamp(max=MAX_REPLACEMENTS))
        each = each.clamp(min=self.section.dead_opacity, max=1 - 1e-6)
        logits, log_scales = gaussians.params["opacity_logits"], gaussians.params["log_scales"]
        logits.copy_(torch.where(drawn, torch.logit(each), logits))
        log_scales.add_(torch.where(drawn, factor.log(), 0.0)[:, None])
