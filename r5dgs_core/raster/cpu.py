"""Backend `cpu`: float32 on any number of threads, forward and backward; results do not depend on that number."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ..scene.cameras import Camera
from . import cpu_blending, cpu_projection, cpu_tiles
from .compile import run
from .reference import frustum_slopes
from .settings import RasterSettings, RasterStats, SplatImage

_WORTH_A_THREAD = 2000  # Gaussians; fewer are projected before a second thread would wake up
_FEW_LABELS = 16  # labels below this are not looked through for gaps
_MOST_LABEL = 1 << 24  # labels below this are whole numbers in float32
_EMPTY = np.empty((0, 0), np.float32)


@dataclass(frozen=True)
class _Pass:
    """What the backward pass needs of the forward pass, all numpy and never handed out."""

    view: np.ndarray
    limits: np.ndarray
    geometry: np.ndarray
    depths: np.ndarray
    tile_starts: np.ndarray
    tile_ends: np.ndarray
    pair_rows: np.ndarray
    pair_slots: np.ndarray
    pair_blocks: np.ndarray
    slot_starts: np.ndarray
    transmittance: np.ndarray
    last_pairs: np.ndarray
    background: np.ndarray


def rasterize_splats(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    channels: torch.Tensor,
    camera: Camera,
    background: torch.Tensor | None,
    labels: torch.Tensor | None,
    settings: RasterSettings,
    stats: RasterStats | None,
) -> SplatImage:
    """Draw as `splatting.rasterize_splats` says; inputs are checked there."""
    image, alpha, depth, ids = _Rasterize.apply(
        means, quats, scales, opacities, channels, background, camera, labels, settings, stats
    )
    return SplatImage(image, alpha, depth, ids if labels is not None else None)


def pack_view(camera: Camera, settings: RasterSettings) -> np.ndarray:
    """Everything that projection needs, in the order of the constants in `cpu_projection`. [26] float64"""
    k, T = camera.intrinsics, camera.T_cam_world
    return np.array(
        [
            *(k[0, 0], k[0, 1], k[0, 2], k[1, 1], k[1, 2]),
            *frustum_slopes(camera, settings),
            *(camera.width, camera.height, settings.near_plane, settings.dilation, settings.alpha_min),
            *T[:3, :3].ravel(),
            *T[:3, 3],
        ],
        np.float64,
    )


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, scales, opacities, channels, background, camera, labels, settings, stats):
        arrays = [t.detach().contiguous().numpy() for t in (means, quats, scales, opacities, channels)]
        n, n_channels = channels.shape
        behind = pack_background(background, n_channels)
        view = pack_view(camera, settings)
        radii = np.empty(cpu_projection.padded_rows(n), np.float32)
        with_state = any(ctx.needs_input_grad)
        state, *results = _forward(arrays, behind, camera, labels, settings, view, radii, with_state)
        if stats is not None:
            stats.radii = torch.from_numpy(radii[:n])
            stats.visible = stats.radii > 0
            stats.grad_norm = torch.zeros(n)
        ctx.set_materialize_grads(False)
        image, alpha, depth, ids = (torch.from_numpy(result) for result in results)
        # Results are saved as tensors: whoever changes one in place gets torch's error instead of a wrong gradient.
        ctx.save_for_backward(means, quats, scales, opacities, channels, image, alpha, depth)
        ctx.state, ctx.stats = state, stats
        ctx.background_shape = None if background is None else background.shape
        ctx.mark_non_differentiable(ids)
        return image, alpha, depth, ids

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, d_image, d_alpha, d_depth, d_ids):
        state: _Pass = ctx.state
        arrays = [t.detach().contiguous().numpy() for t in ctx.saved_tensors]
        if d_image is None:
            d_image = torch.zeros(ctx.saved_tensors[5].shape)
        d_image = d_image.contiguous().numpy()
        d_alpha = _EMPTY if d_alpha is None else d_alpha.contiguous().numpy()
        d_depth = _EMPTY if d_depth is None else d_depth.contiguous().numpy()
        with_geometry = any(ctx.needs_input_grad[:4])
        gradients, grad_norm = _backward(state, arrays, d_image, d_alpha, d_depth, with_geometry)
        if ctx.stats is not None:
            ctx.stats.grad_norm = torch.from_numpy(grad_norm)
        d_background = None
        if ctx.needs_input_grad[5]:
            shown = d_image * state.transmittance[..., None]
            shape = ctx.background_shape
            d_background = torch.from_numpy(shown if len(shape) == 3 else shown.sum((0, 1), dtype=np.float64))
            d_background = d_background.to(torch.float32)
        wanted = (
            torch.from_numpy(g) if needed else None
            for g, needed in zip(gradients, ctx.needs_input_grad[:5], strict=True)
        )
        return (*wanted, d_background, None, None, None, None)


def project(
    view: np.ndarray, arrays: Sequence[np.ndarray], geometry: np.ndarray, depths: np.ndarray, boxes: np.ndarray,
    radii: np.ndarray,
) -> None:  # fmt: skip
    """Project means, quats, scales and opacities; the results are those of `cpu_projection.project`."""
    means, quats, scales, opacities = arrays
    run(
        cpu_projection.project, len(opacities) // _WORTH_A_THREAD,
        view, means.reshape(-1), quats.reshape(-1), scales.reshape(-1), opacities, geometry, depths, boxes, radii,
    )  # fmt: skip


def pack_limits(settings: RasterSettings) -> np.ndarray:
    """The thresholds in the order of the constants in `cpu_exact`. [5] float64"""
    return np.array(
        [
            math.log2(settings.alpha_min),
            math.log2(settings.alpha_max),
            settings.alpha_max,
            settings.finished_at,
            settings.id_alpha_min,
        ]
    )


def pack_background(background: torch.Tensor | None, n_channels: int) -> np.ndarray:
    """One row for all pixels [1, D], or one for each [H * W, D]; float32."""
    if background is None:
        return np.zeros((1, n_channels), np.float32)
    return background.detach().to(torch.float32).contiguous().numpy().reshape(-1, n_channels)


def pack_labels(labels: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """The labels that occur, rising, all negative ones as -1 [L] float32, and the place of each Gaussian's in that [N].

    Raises:
        ValueError: A label is too large to be counted.
    """
    if labels is None:
        return np.empty(0, np.float32), np.empty(0, np.int32)
    labels = np.ascontiguousarray(labels)
    most = labels.max(initial=-1)
    if most >= _MOST_LABEL:
        raise ValueError(f"labels: expected at most {_MOST_LABEL - 1}, found {most} at index {labels.argmax()}")
    if most < _FEW_LABELS and labels.min(initial=-1) >= -1:  # nothing to find: as many planes as numbers
        return np.arange(-1, most + 1, dtype=np.float32), (labels + 1).astype(np.int32)
    names, places = np.unique(np.maximum(labels, -1), return_inverse=True)
    return names.astype(np.float32), places.astype(np.int32)


def aligned(shape: tuple[int, int], dtype: type) -> np.ndarray:
    """An array whose rows of 64 bytes each lie in one cache line."""
    size = shape[0] * shape[1] * np.dtype(dtype).itemsize
    memory = np.empty(size + 64, np.uint8)
    skip = -memory.ctypes.data % 64
    return memory[skip : skip + size].view(dtype).reshape(shape)


def _forward(arrays, background, camera, labels, settings, view, radii, with_state):
    """Project, sort, assign and blend; fills ``radii`` [N]. Returns the state or None, image, alpha, depth and ids."""
    *shapes, channels = arrays
    height, width = camera.height, camera.width
    geometry = aligned((len(radii), cpu_projection.GEOMETRY), np.float64)
    depths, boxes = np.empty(len(radii)), np.empty(len(radii))
    project(view, shapes, geometry, depths, boxes, radii)
    order = cpu_tiles.sort_by_depth(depths, radii)
    tile_starts, pair_rows, pair_slots, slot_starts = cpu_tiles.assign_tiles(
        order, boxes, geometry, width, height, with_state
    )
    names, votes = pack_labels(None if labels is None else labels.detach().numpy())
    limits = pack_limits(settings)
    image = np.empty((height, width, channels.shape[1]), np.float32)
    alpha, depth = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    ids = np.full((height, width) if labels is not None else (0, 0), -1, np.int32)
    transmittance, last_pairs = (np.empty((height, width) if with_state else (0, 0), np.float32) for _ in range(2))
    tiles = np.arange(len(tile_starts) - 1)
    tile_ends, pair_blocks = np.empty(len(tiles), np.int64), np.empty(len(pair_rows), np.uint64)
    run(
        cpu_blending.blend, len(tiles) // 2,
        tiles, tile_starts, pair_rows, geometry, channels, depths, votes, names, background, limits, image, alpha,
        depth, transmittance, last_pairs, ids, tile_ends, pair_blocks,
    )  # fmt: skip
    state = _Pass(
        view, limits, geometry, depths, tile_starts, tile_ends, pair_rows, pair_slots, pair_blocks, slot_starts,
        transmittance, last_pairs, background,
    )  # fmt: skip
    return state if with_state else None, image, alpha, depth, ids


def _backward(state: _Pass, arrays, d_image, d_alpha, d_depth, with_geometry):
    """Gradients of means, quats, scales, opacities and channels, and the norms for densification [N]."""
    means, quats, scales, opacities, channels, _, alpha, depth = arrays
    n, n_channels = channels.shape
    slots = aligned((len(state.pair_rows), cpu_projection.slot_width(n_channels)), np.float32)
    run(
        cpu_blending.blend_backward, len(state.tile_ends) // 2,
        state.tile_starts, state.tile_ends, state.pair_rows, state.pair_slots, state.pair_blocks, state.geometry,
        channels, state.depths, state.background, state.limits, alpha, depth, state.transmittance, state.last_pairs,
        d_image, d_alpha, d_depth, with_geometry, slots,
    )  # fmt: skip
    rows = cpu_projection.padded_rows(n)
    gradients = [np.zeros(rows * k, np.float32) for k in (3, 4, 3, 1, n_channels)]
    grad_norm = np.zeros(rows, np.float32)
    run(
        cpu_projection.project_backward, n // _WORTH_A_THREAD,
        state.view, means.reshape(-1), quats.reshape(-1), scales.reshape(-1), opacities, state.slot_starts, slots,
        with_geometry, n_channels, *gradients, grad_norm,
    )  # fmt: skip
    shapes = [means.shape, quats.shape, scales.shape, opacities.shape, channels.shape]
    shaped = [g[: math.prod(shape)].reshape(shape) for g, shape in zip(gradients, shapes, strict=True)]
    return shaped, grad_norm[:n]
