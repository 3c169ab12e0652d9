"""Gradients of the `cpu` backend: its kernels as functions of torch tensors."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from ..arrays import to_array
from ..backend import ViewPoses
from ..settings import RasterStats
from ..thread_pool import run
from . import blend_backward, forward, projection, sh_kernels

_EMPTY = np.empty((0, 0), np.float32)


def rasterize(
    inputs: Sequence[torch.Tensor | None], plan: forward.CallArguments, stats: RasterStats | None
) -> tuple[torch.Tensor, ...]:
    """Image, alpha, depth and ids of means, quats, scales, opacities, channels and background, float32."""
    return _Rasterize.apply(*inputs, plan, stats)


def seen_colors(
    means: torch.Tensor, sh: torch.Tensor, rest: torch.Tensor | None, factor: torch.Tensor | None, poses: ViewPoses
) -> torch.Tensor:
    """Implement `shade.seen_colors` for float32 tensors on the CPU."""
    return _Shade.apply(means, sh, rest, factor, poses)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, scales, opacities, channels, background, plan, stats):
        inputs = (means, quats, scales, opacities, channels, background)
        arrays = [to_array(t) for t in inputs]
        ctx.state, *results, radii = forward.rasterize(arrays[:5], arrays[5], plan, True)
        if stats is not None:
            stats.fill(torch.from_numpy(radii))
        ctx.set_materialize_grads(False)
        image, alpha, depth, ids = (torch.from_numpy(result) for result in results)
        # Saved as tensors, so that in-place changes raise torch's error instead of giving a wrong gradient.
        ctx.save_for_backward(*inputs, alpha, depth)
        ctx.plan, ctx.stats, ctx.image_shape = plan, stats, image.shape
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
        if ctx.stats is not None:
            ctx.stats.grad_norm = torch.from_numpy(grad_norm)
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
        return (*wanted, d_background, None, None)


def _backward(
    state: forward.ForwardState, plan: forward.CallArguments, inputs, results, d_image, d_alpha, d_depth, with_geometry
):  # fmt: skip
    """Gradients of means, quats, scales, opacities and channels, and the gradient norms for densification [N]."""
    means, quats, scales, opacities, channels = (to_array(t) for t in inputs[:5])
    alpha, depth = (to_array(t) for t in results)
    n, n_channels = channels.shape
    slots = forward.aligned((len(state.pair_rows), projection.slot_width(n_channels)), np.float32)
    filled = np.zeros(len(slots), np.bool_)
    run(
        blend_backward.blend_backward, len(state.tile_ends) // 2,
        state.tile_starts, state.tile_ends, state.pair_rows, state.pair_slots, state.pair_blocks, state.geometry,
        channels, state.depths, forward.pack_background(to_array(inputs[5]), n_channels), plan.limits, alpha, depth,
        state.transmittance, state.last_pairs, d_image, d_alpha, d_depth, with_geometry, slots,
        filled,
    )  # fmt: skip
    rows = projection.padded_rows(n)
    gradients = [np.zeros(rows * k, np.float32) for k in (3, 4, 3, 1, n_channels)]
    grad_norm = np.zeros(rows, np.float32)
    run(
        projection.project_backward, n // forward.WORTH_A_THREAD,
        plan.view, means.reshape(-1), quats.reshape(-1), scales.reshape(-1), opacities, state.slot_starts, slots,
        filled, with_geometry, n_channels, *gradients, grad_norm,
    )  # fmt: skip
    shapes = [means.shape, quats.shape, scales.shape, opacities.shape, channels.shape]
    shaped = [g[: math.prod(shape)].reshape(shape) for g, shape in zip(gradients, shapes, strict=True)]
    return shaped, grad_norm[:n]


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, sh, rest, factor, poses):
        colors = forward.seen_colors(to_array(means), to_array(sh), to_array(rest), to_array(factor), poses)
        ctx.save_for_backward(means, sh, rest, factor)
        ctx.poses = poses
        return torch.from_numpy(colors)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, d_colors):
        means, sh, rest, factor = ctx.saved_tensors
        d_sh = np.empty(sh.shape, np.float32)
        d_rest = d_sh if rest is None else np.empty(rest.shape, np.float32)
        d_means = np.empty((len(means) if ctx.needs_input_grad[0] else 0, 3), np.float32)
        d_factor = np.empty(len(means) if ctx.needs_input_grad[3] else 0, np.float32)
        run(
            sh_kernels.shade_backward, len(means) // forward.WORTH_A_THREAD,
            *forward.shade_inputs(to_array(means), to_array(sh), to_array(rest), to_array(factor), ctx.poses),
            to_array(d_colors),
            d_sh.reshape(-1), d_rest.reshape(-1), d_means, d_factor,
        )  # fmt: skip
        gradients = (d_means, d_sh, d_rest, d_factor)
        wanted = ctx.needs_input_grad[:4]
        return *(torch.from_numpy(g) if w else None for g, w in zip(gradients, wanted, strict=True)), None
