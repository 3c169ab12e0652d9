"""Colours out of spherical harmonics: of Gaussians as an eye sees them, differentiably, and of a sky.

Float32 tensors on the CPU go through the kernels of `sh_kernels`, in one pass and without intermediate arrays; other
tensors, and machines without numba, through plain torch. Harmonics of degree 0 know no direction and need no kernel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ..scene import cameras, sh_color
from ..scene.cameras import Camera
from . import backends

_WORTH_A_THREAD = 2000  # Gaussians
_ROWS_WORTH_A_THREAD = 64  # of a sky
_NO_FACTOR = np.empty(0, np.float32)
_NO_POSES = np.empty(0, np.int64)


def seen_colors(
    means: torch.Tensor,  # [N, 3]
    sh: torch.Tensor,  # [N, K, 3] or [N, 1, 3]
    eyes: np.ndarray,  # [3] or [P, 3]
    *,
    rest: torch.Tensor | None = None,  # [N, K - 1, 3]
    view_maps: np.ndarray | None = None,  # [P, 3, 3]
    pose_ids: Any = None,  # [N]
    factor: torch.Tensor | None = None,  # [N]
    fused: bool = True,
) -> torch.Tensor:
    """Display-referred colour of each Gaussian: factor times max(0, 0.5 + harmonics along the line of sight).

    Differentiable in means, coefficients and factor. A Gaussian at the eye shows its harmonics of degree 0, and a
    clamped colour sends no gradient back.

    Args:
        means: Centres. [N, 3]
        sh: Coefficients in the order of `sh_color.basis`; those of degree 0 alone where ``rest`` is given.
        eyes: Eye of each pose in the frame of ``means``, or one for all. [P, 3] or [3]
        rest: The coefficients of degree 1 and more. [N, K - 1, 3]
        view_maps: Linear maps that bring the directions of each pose into the frame of the coefficients, up to length;
            none where None. [P, 3, 3]
        pose_ids: Pose of each Gaussian; the first for all where None. [N] integers, array or tensor
        factor: On the colour; 1 where None. [N]
        fused: Whether the kernels may be used where they can.

    Returns:
        The colours, not clamped at 1, dtype and device of ``means``. [N, 3]

    Raises:
        ValueError: A shape does not fit, or a pose is not there.
    """
    n = len(means)
    count = sh.shape[1] + (0 if rest is None else rest.shape[1]) if sh.ndim == 3 else 0
    for name, tensor, shape in (
        ("means", means, (n, 3)),
        ("sh", sh, (n, count if rest is None else 1, 3)),
        ("sh_rest", rest, (n, count - 1, 3)),
        ("factor", factor, (n,)),
    ):
        if tensor is not None and tuple(tensor.shape) != shape:
            raise ValueError(f"{name}: expected shape {shape}, got {tuple(tensor.shape)}")
    if sh_color.degree_of(count) == 0:
        colors = sh_color.dc_to_rgb(sh[:, 0]).clamp_min(0)
        return colors if factor is None else colors * factor[:, None]
    poses = _Poses(eyes, view_maps, pose_ids, n)
    if fused and _fits_kernels(means, sh, rest, factor):
        return _Shade.apply(means, sh, rest, factor, poses)
    return _plain_colors(means, sh if rest is None else torch.cat([sh, rest], 1), factor, poses)


def sky(sh: np.ndarray, camera: Camera) -> np.ndarray:
    """A sky as a camera sees it: 0.5 + harmonics along the ray of each pixel, within [0, 1].

    Args:
        sh: Coefficients over the world's directions. [K, 3]
        camera: The camera.

    Returns:
        Display-referred sRGB. [H, W, 3] float32
    """
    sh = np.array(sh, np.float64)
    if sh_color.degree_of(len(sh)) == 0:
        color = np.clip(sh_color.dc_to_rgb(sh[0]), 0, 1)
        return np.broadcast_to(color.astype(np.float32), (camera.height, camera.width, 3))
    if not backends.numba_is_there():
        return np.clip(sh_color.to_rgb(sh, cameras.pixel_rays(camera)), 0, 1).astype(np.float32)
    from .cpu import compilation, sky

    rays = camera.T_cam_world[:3, :3].T @ np.linalg.inv(camera.intrinsics)
    image = np.empty((camera.height, camera.width, 3), np.float32)
    compilation.run(sky.draw_sky, camera.height // _ROWS_WORTH_A_THREAD, np.ascontiguousarray(rays), sh, image)
    return image


class _Poses:
    """Eyes [P, 3] and maps [P, 3, 3], float64, and the pose of each Gaussian: [N], or [0] where all have the first."""

    def __init__(self, eyes: np.ndarray, view_maps: np.ndarray | None, pose_ids: Any, n: int):
        eyes = np.asarray(eyes, np.float64).reshape(-1, 3)
        maps = np.eye(3)[None] if view_maps is None else np.asarray(view_maps, np.float64).reshape(-1, 3, 3)
        count = max(len(eyes), len(maps))
        if not {len(eyes), len(maps)} <= {1, count}:
            raise ValueError(f"view_maps: expected one for each of {len(eyes)} eyes, got {len(maps)}")
        # Copies, so that the kernels see one kind of array, contiguous and never read-only, and that nothing that
        # happens to the caller's before the backward pass changes what it computes.
        self.eyes = np.broadcast_to(eyes, (count, 3)).copy()
        self.maps = np.broadcast_to(maps, (count, 3, 3)).copy()
        self.ids = _NO_POSES
        if pose_ids is not None:
            host = pose_ids.detach().cpu().numpy() if isinstance(pose_ids, torch.Tensor) else pose_ids
            self.ids = np.array(host, np.int64)
            if self.ids.shape != (n,) or (n and not 0 <= self.ids.min() <= self.ids.max() < count):
                raise ValueError(f"pose_ids: expected {n} rows of {count} poses, got {self.ids!r}")


def _fits_kernels(*tensors: torch.Tensor | None) -> bool:
    given = [tensor for tensor in tensors if tensor is not None]
    return all(t.dtype == torch.float32 and t.device.type == "cpu" for t in given) and backends.numba_is_there()


def _plain_colors(
    means: torch.Tensor, sh: torch.Tensor, factor: torch.Tensor | None, poses: _Poses
) -> torch.Tensor:  # fmt: skip
    """`seen_colors` in plain torch."""

    def like_means(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array, dtype=means.dtype, device=means.device)

    ids = torch.as_tensor(poses.ids, device=means.device) if len(poses.ids) else slice(0, 1)
    offsets = (like_means(poses.maps)[ids] @ (means - like_means(poses.eyes)[ids])[..., None])[..., 0]
    square = (offsets * offsets).sum(-1, keepdim=True)
    at_the_eye = square <= 0
    lengths = torch.sqrt(torch.where(at_the_eye, torch.ones_like(square), square))
    directions = torch.where(at_the_eye, torch.zeros_like(offsets), offsets / lengths)
    colors = sh_color.to_rgb(sh, directions).clamp_min(0)
    return colors if factor is None else colors * factor[:, None]


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, sh, rest, factor, poses):
        from .cpu import compilation, sh_kernels

        colors = np.empty((len(means), 3), np.float32)
        inputs = _kernel_inputs(means, sh, rest, factor, poses)
        compilation.run(sh_kernels.shade, len(means) // _WORTH_A_THREAD, *inputs, colors)
        ctx.save_for_backward(means, sh, rest, factor)
        ctx.poses = poses
        return torch.from_numpy(colors)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, d_colors):
        from .cpu import compilation, sh_kernels

        means, sh, rest, factor = ctx.saved_tensors
        d_sh = np.empty(sh.shape, np.float32)
        d_rest = d_sh if rest is None else np.empty(rest.shape, np.float32)
        d_means = np.empty((len(means) if ctx.needs_input_grad[0] else 0, 3), np.float32)
        d_factor = np.empty(len(means) if ctx.needs_input_grad[3] else 0, np.float32)
        compilation.run(
            sh_kernels.shade_backward, len(means) // _WORTH_A_THREAD,
            *_kernel_inputs(means, sh, rest, factor, ctx.poses), _array(d_colors),
            d_sh.reshape(-1), d_rest.reshape(-1), d_means, d_factor,
        )  # fmt: skip
        gradients = (d_means, d_sh, d_rest, d_factor)
        wanted = ctx.needs_input_grad[:4]
        return *(torch.from_numpy(g) if w else None for g, w in zip(gradients, wanted, strict=True)), None


def _kernel_inputs(means, sh, rest, factor, poses: _Poses) -> tuple:
    """What both kernels read, in their order."""
    constants = _array(sh).reshape(-1)
    if rest is None:
        count = sh.shape[1]
        coefficients = (constants, 3 * count, constants, 3, 3 * count, count)
    else:
        count = 1 + rest.shape[1]
        coefficients = (constants, 3, _array(rest).reshape(-1), 0, 3 * (count - 1), count)
    strength = _NO_FACTOR if factor is None else _array(factor)
    return _array(means), poses.eyes, poses.maps, poses.ids, *coefficients, strength


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()
