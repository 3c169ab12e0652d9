"""Positional encoding of positions and times, and helpers of the MLPs that use it."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.utils import checkpoint as checkpointing


def encode(x: Tensor, bands: int) -> Tensor:
    """Return x, then sine and cosine of 2^k x for k = 0 .. bands - 1, without a factor of pi.

    Args:
        x: Positions or times. [..., C]
        bands: Number of octaves.

    Returns:
        x, sin x, cos x, sin 2x, cos 2x, ... [..., C (1 + 2 bands)]

    Source: NeRF (Mildenhall et al. 2020), Eq. 4, in the form of Deformable 3D Gaussians.
    """
    if x.device.type != "cpu":  # few large operations; on a CPU the many small ones are as fast
        angles = x[..., None, :] * torch.exp2(torch.arange(bands, dtype=x.dtype, device=x.device))[:, None]
        return torch.cat([x, torch.stack([angles.sin(), angles.cos()], -2).flatten(-3)], dim=-1)
    parts = [x]
    for k in range(bands):
        parts += [torch.sin(2.0**k * x), torch.cos(2.0**k * x)]
    return torch.cat(parts, dim=-1)


def times(like: Tensor, count: int, t: float | Tensor) -> Tensor:
    """Return a column of ``count`` times, a number or a tensor [], with dtype and device of another tensor."""
    return t.to(like.dtype).expand(count, 1) if isinstance(t, Tensor) else like.new_full((count, 1), t)


def encoded_size(channels: int, bands: int) -> int:
    """Number of channels that `encode` returns for ``channels`` inputs."""
    return channels * (1 + 2 * bands)


def linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """Create a linear layer with PyTorch's default initialisation, drawn from ``generator``."""
    layer = nn.Linear(inputs, outputs)
    bound = 1 / math.sqrt(inputs)
    with torch.no_grad():
        for tensor in (layer.weight, layer.bias):
            tensor.copy_((2 * torch.rand(tensor.shape, generator=generator) - 1) * bound)
    return layer


def in_chunks(function: Callable[[Tensor], Tensor], rows: Tensor, chunk: int) -> Tensor:
    """Apply ``function`` to the rows in chunks, so that only the intermediate values of one chunk are in memory.

    With gradients, several chunks are recomputed in the backward pass (checkpointing).
    """
    if len(rows) <= chunk:
        return function(rows)
    if not torch.is_grad_enabled():
        return torch.cat([function(part) for part in rows.split(chunk)])
    parts = [
        checkpointing.checkpoint(function, part, use_reentrant=False, preserve_rng_state=False)
        for part in rows.split(chunk)
    ]
    return torch.cat(parts)
