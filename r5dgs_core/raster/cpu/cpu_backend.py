"""Backend `cpu`: float32 on any number of threads, forward and backward. Results do not depend on that number."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ...scene.cameras import Camera
from ..compilation import run
from ..reference import frustum_slopes
from ..settings import RasterSettings, RasterStats, SplatImage
from . import blend, blend_backward, projection
from . import segments as cpu_segments
from . import tiles as cpu_tiles

_WORTH_A_THREAD = 2000  # Gaussians per thread; fewer are projected before a second thread wakes up
_FEW_LABELS = 16  # labels below this are used without removing gaps
_MOST_LABEL = 1 << 24  # labels below this are exact in float32
# Distance of log2(alpha) from a threshold below which float64 decides: several times the largest rounding error of thin
# Gaussians at the usual dilation. The error grows with the whitening.
_CLOSE_LOG2, _USUAL_DILATION = 2e-4, 0.3
_EMPTY = np.empty((0, 0), np.float32)


@dataclass(frozen=True)
class _Plan:
    """Arguments of a call other than its tensors."""

    camera: Camera
    view: np.ndarray
    limits: np.ndarray
    names_votes: tuple[np.ndarray, np.ndarray]
    stats: RasterStats | None


@dataclass(frozen=True)
class _Pass:
    """State of the forward pass for the backward pass, numpy arrays that are never exposed."""

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
    """Implement `rasterizer.rasterize_splats`, which checks the inputs."""
    view, limits, votes = pack_view(camera, settings), pack_limits(settings), pack_labels(labels)
    plan = _Plan(camera, view, limits, votes, stats)
    inputs = (means, quats, scales, opacities, channels, background)
    if torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in inputs):
        image, alpha, depth, ids = _Rasterize.apply(*inputs, plan)
    else:
        _, *results = _forward(inputs, plan, False)
        image, alpha, depth, ids = (torch.from_numpy(result) for result in results)
    return SplatImage(image, alpha, depth, ids if labels is not None else None)


def pack_view(camera: Camera, settings: RasterSettings) -> np.ndarray:
    """Camera and settings of the projection, in the order of the constants in `projection`. [26] float64"""
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
    def forward(ctx, means, quats, scales, opacities, channels, background, plan):
        inputs = (means, quats, scales, opacities, channels, background)
        ctx.state, *results = _forward(inputs, plan, True)
        ctx.set_materialize_grads(False)
        image, alpha, depth, ids = (torch.from_numpy(result) for result in results)
        # Saved as tensors, so that in-place changes raise torch's error instead of giving a wrong gradient.
        ctx.save_for_backward(*inputs, alpha, depth)
        ctx.plan, ctx.image_shape = plan, image.shape
        ctx.mark_non_differentiable(ids)
        return image, alpha, depth, ids

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, d_image, d_alpha, d_depth, d_ids):
        inputs, results = ctx.saved_tensors[:6], ctx.saved_tensors[6:]
        state, plan, background = ctx.state, ctx.plan, inputs[5]
        if d_image is None:
            d_image = torch.zeros(ctx.image_shape)
        d_image = d_image.contiguous().numpy()
        d_alpha = _EMPTY if d_alpha is None else d_alpha.contiguous().numpy()
        d_depth = _EMPTY if d_depth is None else d_depth.contiguous().numpy()
        with_geometry = any(ctx.needs_input_grad[:4])
        gradients, grad_norm = _backward(state, plan, inputs, results, d_image, d_alpha, d_depth, with_geometry)
        if plan.stats is not None:
            plan.stats.grad_norm = torch.from_numpy(grad_norm)
        d_background = None
        if ctx.needs_input_grad[5]:
            shown = d_image * state.transmittance[..., None]
            each_pixel = background.ndim == 3
            d_background = torch.from_numpy(shown if each_pixel else shown.sum((0, 1), dtype=np.float64))
            d_background = d_background.to(background.dtype)
        wanted = (
            torch.from_numpy(g) if needed else None
            for g, needed in zip(gradients, ctx.needs_input_grad[:5], strict=True)
        )
        return (*wanted, d_background, None)


def project(
    view: np.ndarray, arrays: Sequence[np.ndarray], geometry: np.ndarray, depths: np.ndarray, boxes: np.ndarray,
    radii: np.ndarray,
) -> None:  # fmt: skip
    """Project means, quats, scales and opacities; results as in `projection.project`."""
    means, quats, scales, opacities = arrays
    run(
        projection.project, len(opacities) // _WORTH_A_THREAD,
        view, means.reshape(-1), quats.reshape(-1), scales.reshape(-1), opacities, geometry, depths, boxes, radii,
    )  # fmt: skip


def pack_limits(settings: RasterSettings) -> np.ndarray:
    """Thresholds in the order of the constants in `exact_thresholds`. [6] float64"""
    return np.array(
        [
            math.log2(settings.alpha_min),
            math.log2(settings.alpha_max),
            settings.alpha_max,
            settings.finished_at,
            settings.id_alpha_min,
            _CLOSE_LOG2 * max(1.0, math.sqrt(_USUAL_DILATION / settings.dilation)),
        ]
    )


def pack_background(background: torch.Tensor | None, n_channels: int) -> np.ndarray:
    """Background as one row for all pixels [1, D], or one per pixel [H * W, D]; float32."""
    if background is None:
        return np.zeros((1, n_channels), np.float32)
    return background.detach().to(torch.float32).contiguous().numpy().reshape(-1, n_channels)


def pack_labels(labels: torch.Tensor | None) -> tuple[np.ndarray, np.ndarray]:
    """Distinct labels, ascending, negative ones as -1 [L] float32, and the index of each Gaussian's label [N] int32.

    Raises:
        ValueError: A label is 2^24 or more.
    """
    if labels is None:
        return np.empty(0, np.float32), np.empty(0, np.int32)
    numbers = to_numbers(labels)
    most = numbers.max(initial=-1)
    if most < _FEW_LABELS and numbers.min(initial=-1) >= -1:  # one plane per number, without a search for gaps
        return np.arange(-1, most + 1, dtype=np.float32), (numbers + 1).astype(np.int32)
    names, places = np.unique(np.maximum(numbers, -1), return_inverse=True)
    return names.astype(np.float32), places.astype(np.int32)


def to_numbers(labels: torch.Tensor) -> np.ndarray:
    """Convert labels of any integer type to int64. Raises ValueError if one is 2^24 or more."""
    numbers = labels.detach().numpy().astype(np.int64)
    if len(numbers) and numbers.max() >= _MOST_LABEL:
        at = numbers.argmax()
        raise ValueError(f"labels: expected at most {_MOST_LABEL - 1}, found {numbers[at]} at index {at}")
    return numbers


def to_array(tensor: torch.Tensor) -> np.ndarray:
    """View a tensor's memory as a C-contiguous array."""
    return tensor.detach().contiguous().numpy()


def aligned(shape: tuple[int, int], dtype: type) -> np.ndarray:
    """Allocate an array aligned to 64 bytes, so that each row of 64 bytes is one cache line."""
    size = shape[0] * shape[1] * np.dtype(dtype).itemsize
    memory = np.empty(size + 64, np.uint8)
    skip = -memory.ctypes.data % 64
    return memory[skip : skip + size].view(dtype).reshape(shape)


def segment_weights(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    camera: Camera,
    segments: np.ndarray,  # [H, W] int32
    count: int,
    settings: RasterSettings,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights of Gaussians in segments of an image as entries: Gaussians, segments, weights. [E] each

    There is one entry per tile, so entries of the same Gaussian and segment must be summed. Inputs as for
    `segment_weights.segment_weights`, which checks them.
    """
    limits = pack_limits(settings)
    plan = _Plan(camera, pack_view(camera, settings), limits, pack_labels(None), None)
    inputs = (means, quats, scales, opacities, opacities[:, None], None)
    state, *_ = _forward(inputs, plan, True, with_slots=False)
    assert state is not None
    starts = np.append(0, np.cumsum(_kinds_per_tile(segments) * (state.tile_ends - state.tile_starts[:-1])))
    counts = np.zeros(len(state.tile_ends), np.int64)
    entries = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32), np.empty(starts[-1], np.float32)
    run(
        cpu_segments.weigh_segments, len(counts) // 2,
        state.tile_starts, state.tile_ends, state.pair_rows, state.pair_blocks, state.geometry, state.depths, limits,
        state.last_pairs, segments, count, starts, counts, *entries,
    )  # fmt: skip
    written = [slice(start, start + of_tile) for start, of_tile in zip(starts, counts, strict=False)]
    rows, names, weights = (np.concatenate([array[part] for part in written]) for array in entries)
    return rows, names, weights


def _kinds_per_tile(segments: np.ndarray) -> np.ndarray:
    """Number of segments in each tile. [H, W] -> [tiles] int64"""
    size = projection.TILE
    rows, columns = (-(-side // size) for side in segments.shape)
    padded = np.full((rows * size, columns * size), -1, np.int32)
    padded[: segments.shape[0], : segments.shape[1]] = segments
    tiles = padded.reshape(rows, size, columns, size).swapaxes(1, 2).reshape(rows * columns, size * size)
    tiles = np.sort(np.maximum(tiles, -1), axis=1)
    return (tiles[:, 0] >= 0) + (np.diff(tiles, axis=1) > 0).sum(axis=1)


def _forward(inputs, plan: _Plan, with_state: bool, with_slots: bool = True):
    """Project, sort, assign and blend. Returns the state or None, image, alpha, depth and ids.

    The state supports gradients only if ``with_slots`` is True.
    """
    *shapes, channels = (to_array(t) for t in inputs[:5])
    (n, n_channels), height, width = channels.shape, plan.camera.height, plan.camera.width
    rows = projection.padded_rows(n)
    geometry = aligned((rows, projection.GEOMETRY), np.float64)
    depths, boxes, radii = np.empty(rows), np.empty(rows), np.empty(rows, np.float32)
    project(plan.view, shapes, geometry, depths, boxes, radii)
    order = cpu_tiles.sort_by_depth(depths, radii)
    tile_starts, pair_rows, pair_slots, slot_starts = cpu_tiles.assign_tiles(
        order, boxes, geometry, width, height, with_state and with_slots
    )
    names, votes = plan.names_votes
    image = np.empty((height, width, n_channels), np.float32)
    alpha, depth = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    ids = np.full((height, width) if len(names) else (0, 0), -1, np.int32)
    transmittance, last_pairs = (np.empty((height, width) if with_state else (0, 0), np.float32) for _ in range(2))
    tiles = np.arange(len(tile_starts) - 1)
    tile_ends, pair_blocks = np.empty(len(tiles), np.int64), np.empty(len(pair_rows), np.uint64)
    run(
        blend.blend, len(tiles) // 2,
        tiles, tile_starts, pair_rows, geometry, channels, depths, votes, names,
        pack_background(inputs[5], n_channels), plan.limits, image, alpha, depth, transmittance, last_pairs, ids,
        tile_ends, pair_blocks,
    )  # fmt: skip
    if plan.stats is not None:
        plan.stats.radii = torch.from_numpy(radii[:n])
        plan.stats.visible = plan.stats.radii > 0
        plan.stats.grad_norm = torch.zeros(n)
    state = None
    if with_state:
        state = _Pass(
            geometry, depths, tile_starts, tile_ends, pair_rows, pair_slots, pair_blocks, slot_starts, transmittance,
            last_pairs,
        )  # fmt: skip
    return state, image, alpha, depth, ids


def _backward(state: _Pass, plan: _Plan, inputs, results, d_image, d_alpha, d_depth, with_geometry):
    """Gradients of means, quats, scales, opacities and channels, and the gradient norms for densification [N]."""
    means, quats, scales, opacities, channels = (to_array(t) for t in inputs[:5])
    alpha, depth = (to_array(t) for t in results)
    n, n_channels = channels.shape
    slots = aligned((len(state.pair_rows), projection.slot_width(n_channels)), np.float32)
    filled = np.zeros(len(slots), np.bool_)
    run(
        blend_backward.blend_backward, len(state.tile_ends) // 2,
        state.tile_starts, state.tile_ends, state.pair_rows, state.pair_slots, state.pair_blocks, state.geometry,
        channels, state.depths, pack_background(inputs[5], n_channels), plan.limits, alpha, depth,
        state.transmittance, state.last_pairs, d_image, d_alpha, d_depth, with_geometry, slots,
        filled,
    )  # fmt: skip
    rows = projection.padded_rows(n)
    gradients = [np.zeros(rows * k, np.float32) for k in (3, 4, 3, 1, n_channels)]
    grad_norm = np.zeros(rows, np.float32)
    run(
        projection.project_backward, n // _WORTH_A_THREAD,
        plan.view, means.reshape(-1), quats.reshape(-1), scales.reshape(-1), opacities, state.slot_starts, slots,
        filled, with_geometry, n_channels, *gradients, grad_norm,
    )  # fmt: skip
    shapes = [means.shape, quats.shape, scales.shape, opacities.shape, channels.shape]
    shaped = [g[: math.prod(shape)].reshape(shape) for g, shape in zip(gradients, shapes, strict=True)]
    return shaped, grad_norm[:n]
