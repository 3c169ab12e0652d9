"""Projection of Gaussians and their tile lists for the kernels of gsplat: `exact` in float64, or `fused` in float32."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..scene.cameras import Camera
from . import reference
from .settings import RasterSettings, RasterStats

TILE = 16  # px; gsplat tunes its kernels for this size
FUSED_SLACK = 0.3  # `RasterSettings.frustum_slack` that is compiled into gsplat's projection


@dataclass(frozen=True)
class Kernels:
    """Functions of gsplat, and the thresholds compiled into them.

    Attributes:
        isect_tiles: Returns pairs of tile and Gaussian, sorted by tile and depth.
        isect_offset_encode: Returns the first pair of each tile.
        rasterize_to_pixels: Returns blended channels and alpha, differentiable.
        fully_fused_projection: Returns radii, centres, depths and inverse covariances, differentiable.
        version: gsplat version, for messages.
        alpha_min: Contributions below this are dropped.
        alpha_max: Cap on contributions.
        transmittance_min: A pixel is finished before its transmittance reaches this.
    """

    isect_tiles: Callable[..., tuple[Tensor, Tensor, Tensor]]
    isect_offset_encode: Callable[..., Tensor]
    rasterize_to_pixels: Callable[..., tuple[Tensor, Tensor]]
    fully_fused_projection: Callable[..., tuple[Tensor, ...]]
    version: str
    alpha_min: float
    alpha_max: float
    transmittance_min: float


@dataclass(frozen=True)
class Projected:
    """Projected Gaussians in gsplat's layout, and the tiles that they touch.

    Attributes:
        rows: Rows of the V Gaussians among all; None for all Gaussians. [V]
        means2d: Centres, px. [V, 2]
        conics: Inverse covariances xx, xy, yy, px^-2. [V, 3]
        opacities: In [0, 1]. [V]
        depths: Depths in the camera frame. [V]
        tile_starts: First pair of each tile. [1, tiles high, tiles wide]
        pairs: Gaussian of each pair, near to far in each tile. [P]
        width, height: Size of the image, px.
    """

    rows: Tensor | None
    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    depths: Tensor
    tile_starts: Tensor
    pairs: Tensor
    width: int
    height: int

    def of(self, values: Tensor) -> Tensor:
        """Return the values of the projected Gaussians among those of all. [N, ...] -> [V, ...]"""
        return values if self.rows is None else values[self.rows]


class Inputs(NamedTuple):
    """Arguments of `rasterizer.rasterize_splats` that the projection needs, and gsplat."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    camera: Camera
    settings: RasterSettings
    stats: RasterStats | None
    kernels: Kernels


def project(given: Inputs) -> Projected:
    """Project Gaussians, and fill the statistics.

    gsplat's own projection is used if the settings permit it and it supports them and the camera.
    """
    camera, settings = given.camera, given.settings
    fits = camera.intrinsics[0, 1] == 0 and settings.frustum_slack == FUSED_SLACK and len(given.means) > 0
    return exact(given) if settings.exact or not fits else fused(given)


def exact(given: Inputs) -> Projected:
    """Project, cull and sort in float64 as the reference does; only Gaussians that touch the image are returned."""
    means, quats, scales, opacities, camera, settings, stats, kernels = given
    with torch.no_grad():
        projected = reference.project(means.double(), quats.double(), scales.double(), camera, settings)
        means2d, axes, z = projected
        cov, _ = reference.covariances(axes, settings.dilation)
        order, extent = reference.visible_rows(means2d, cov, z, opacities.double(), camera, settings)
        tile_starts, pairs = _tile_lists(means2d[order], extent[order], camera, kernels)
    if torch.is_grad_enabled() and any(t.requires_grad for t in (means, quats, scales)):
        # Project only visible Gaussians with gradients: the graph of a float64 projection dominates the memory.
        seen = (means[order].double(), quats[order].double(), scales[order].double())
        means2d, axes, z = reference.project(*seen, camera, settings)
    else:
        means2d, axes, z = (t[order] for t in projected)
    cov, determinant = reference.covariances(axes, settings.dilation)
    if stats is not None:
        _fill_exact_stats(stats, means2d, cov, order, means)
    inverse = torch.stack([cov[:, 1, 1], -cov[:, 0, 1], cov[:, 0, 0]], 1) / determinant[:, None]
    numbers = (means2d.float(), inverse.float(), opacities[order], z.float())
    return Projected(order, *numbers, tile_starts, pairs, camera.width, camera.height)


def fused(given: Inputs) -> Projected:
    """Project, cull and sort by gsplat's kernels in float32; rows of Gaussians outside the image are meaningless."""
    means, quats, scales, opacities, camera, settings, stats, kernels = given
    view, lens = matrices(camera, means.device)
    radii, means2d, depths, conics, _ = kernels.fully_fused_projection(
        means,
        None,
        quats,
        scales,
        view,
        lens,
        camera.width,
        camera.height,
        eps2d=settings.dilation,
        near_plane=settings.near_plane,
        opacities=opacities.detach(),
    )
    if stats is not None:
        _fill_fused_stats(stats, means2d, conics, radii)
    with torch.no_grad():
        tiles_x, tiles_y = _tile_counts(camera)
        if stats is not None and stats.capacity:
            listed = _bounded_tile_lists(means2d[0], radii[0], depths[0], tiles_x, tiles_y, stats.capacity)
            tile_starts, pairs, stats.pairs = listed
        else:
            _, keys, pairs = kernels.isect_tiles(means2d, radii, depths, TILE, tiles_x, tiles_y)
            tile_starts = kernels.isect_offset_encode(keys, 1, tiles_x, tiles_y)
    numbers = (means2d[0], conics[0], opacities, depths[0])
    return Projected(None, *numbers, tile_starts, pairs, camera.width, camera.height)


@dataclass(frozen=True, kw_only=True)
class PlacedCamera(Camera):
    """A camera whose pose and intrinsics are those of two tensors on the device; the arrays only give the kind of lens.

    Attributes:
        view: World to camera. [1, 4, 4]
        lens: Intrinsics, px. [1, 3, 3]
    """

    view: Tensor
    lens: Tensor


def matrices(camera: Camera, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return pose [1, 4, 4] and intrinsics [1, 3, 3] of a camera on a device."""
    if isinstance(camera, PlacedCamera):
        return camera.view, camera.lens
    return _matrices(camera.T_cam_world.tobytes(), camera.intrinsics.tobytes(), device)


@functools.lru_cache(maxsize=4096)
def _matrices(pose: bytes, intrinsics: bytes, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return pose [1, 4, 4] and intrinsics [1, 3, 3] of a camera on a device; cached, as copying them waits for it."""
    both = ((pose, 4), (intrinsics, 3))
    view, lens = (
        torch.from_numpy(np.frombuffer(content).reshape(1, side, side).astype(np.float32)).to(device)
        for content, side in both
    )
    return view, lens


def _bounded_tile_lists(
    means2d: Tensor, radii: Tensor, depths: Tensor, tiles_x: int, tiles_y: int, capacity: int
) -> tuple[Tensor, Tensor, Tensor]:
    """List the Gaussians of each tile as gsplat does, with a fixed number of pairs, so that nothing waits for it.

    Unused pairs belong to the first tile of a row below the image, where gsplat draws nothing.

    Returns:
        First pair of each tile [1, tiles high + 1, tiles wide], Gaussian of each pair [capacity], and the number of
        pairs that would be needed [].
    """
    limits = torch.stack([torch.full_like(means2d[0, 0], tiles_x), torch.full_like(means2d[0, 0], tiles_y)])
    low = torch.minimum(((means2d - radii) / TILE).floor().clamp_min(0), limits).long()
    high = torch.minimum(((means2d + radii) / TILE).ceil().clamp_min(0), limits).long()
    span = (high - low) * (radii > 0).all(1, keepdim=True)
    counts = span[:, 0] * span[:, 1]
    ends = counts.cumsum(0)
    slots = torch.arange(capacity, device=means2d.device)
    rows = torch.searchsorted(ends, slots, right=True).clamp_max(len(ends) - 1)
    step, wide = slots - (ends - counts)[rows], span[rows, 0].clamp_min(1)
    tiles = (low[rows, 1] + step // wide) * tiles_x + low[rows, 0] + step % wide
    tiles = torch.where(slots < ends[-1], tiles, tiles_x * tiles_y)
    depth_bits = depths.contiguous().view(torch.int32).long()[rows] & 0x7FFFFFFF
    keys, order = torch.sort(tiles << 32 | depth_bits, stable=True)
    first = torch.searchsorted(keys >> 32, torch.arange((tiles_y + 1) * tiles_x, device=means2d.device))
    return first.int().view(1, tiles_y + 1, tiles_x), rows[order].int(), ends[-1]


def _tile_lists(means2d: Tensor, extent: Tensor, camera: Camera, kernels: Kernels) -> tuple[Tensor, Tensor]:
    """List the Gaussians of each tile: first pair of each tile [1, tiles high, tiles wide], Gaussian of each pair [P].

    gsplat gets the box of each alpha_min ellipse [V, 2], clipped to the image, which keeps its numbers small. Depths
    are replaced by ranks, which float32 does not round together. Ranks beyond 2^24 (16.7 million) may be equal, but the
    sort is stable.
    """
    size = means2d.new_tensor([camera.width, camera.height])
    low, high = (means2d - extent).clamp_min(0), torch.minimum(means2d + extent, size)
    radii = torch.ceil(0.5 * (high - low)).clamp_min(1).int()
    ranks = torch.arange(len(means2d), dtype=torch.float32, device=means2d.device)
    tiles_x, tiles_y = _tile_counts(camera)
    if not len(means2d):
        return ranks.new_zeros((1, tiles_y, tiles_x), dtype=torch.int32), ranks.int()
    centers = (0.5 * (low + high)).float()
    _, keys, pairs = kernels.isect_tiles(centers[None], radii[None], ranks[None], TILE, tiles_x, tiles_y)
    return kernels.isect_offset_encode(keys, 1, tiles_x, tiles_y), pairs


def _tile_counts(camera: Camera) -> tuple[int, int]:
    """Return the numbers of columns and rows of tiles."""
    return -(-camera.width // TILE), -(-camera.height // TILE)


@torch.no_grad()
def _fill_exact_stats(stats: RasterStats, means2d: Tensor, cov: Tensor, order: Tensor, means: Tensor) -> None:
    """Fill the statistics of `exact`."""

    def spread(rows: Tensor) -> Tensor:
        """Scatter rows of the visible Gaussians to all Gaussians, zero elsewhere. [N]"""
        return means.new_zeros(len(means)).index_copy_(0, order, rows.to(means.dtype))

    longest = reference.radii(cov)
    visible = spread(torch.ones_like(longest)) > 0
    _fill_stats(stats, visible, spread(longest), means2d, lambda grad: spread(grad.norm(dim=1)))


@torch.no_grad()
def _fill_fused_stats(stats: RasterStats, means2d: Tensor, conics: Tensor, radii: Tensor) -> None:
    """Fill the statistics of `fused`."""
    xx, xy, yy = conics[0].unbind(-1)
    least = 0.5 * (xx + yy) - torch.hypot(0.5 * (xx - yy), xy)
    visible = radii[0, :, 0] > 0
    longest = torch.where(visible, 3 * least.clamp(min=1e-12).rsqrt(), 0.0)
    _fill_stats(stats, visible, longest, means2d, lambda grad: grad[0].norm(dim=1))


def _fill_stats(
    stats: RasterStats, visible: Tensor, radii: Tensor, means2d: Tensor, norms: Callable[[Tensor], Tensor]
) -> None:
    """Write visibility and radii now, and the norm of the screen-space gradient in the backward pass."""
    stats.visible, stats.radii, stats.grad_norm = visible, radii, torch.zeros_like(radii)
    if means2d.requires_grad:

        def keep_norms(gradient: Tensor) -> None:
            stats.grad_norm = norms(gradient)

        means2d.register_hook(keep_norms)
