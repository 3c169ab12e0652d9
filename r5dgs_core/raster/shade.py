"""Colours from spherical harmonics: view-dependent colours of Gaussians, differentiable, and skies.

Float32 tensors on the CPU use the fused kernels of `sh_kernels`; other tensors, and machines without numba, use plain
torch. Degree 0 does not depend on the direction and needs no kernel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ..scene import cameras, sh_color
from ..scene.cameras import Camera
from . import backends

_WORTH_A_THREAD = 2000  # Gaussians per thread
_ROWS_WORTH_A_THREAD = 64  # rows of a sky per thread
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
    """Return the display-referred colour of each Gaussian: factor * max(0, 0.5 + harmonics along the line of sight).

    Differentiable in means, coefficients and factor. A Gaussian at the eye has its degree-0 colour. Clamped colours
    have zero gradient.

    Args:
        means: Centres. [N, 3]
        sh: Coefficients in the order of `sh_color.basis`; only those of degree 0 if ``rest`` is given.
        eyes: Eye of each pose in the frame of ``means``, or one for all. [P, 3] or [3]
        rest: Coefficients of degree 1 and higher. [N, K - 1, 3]
        view_maps: Linear map of each pose from directions to the frame of the coefficients; the result is normalised.
            None for the identity. [P, 3, 3]
        pose_ids: Pose of each Gaussian; None for the first. [N] integers, array or tensor
        factor: Factor on the colour; 1 if None. [N]
        fused: True to allow the kernels.

    Returns:
        Colours, not clamped at 1, dtype and device of ``means``. [N, 3]

    Raises:
        ValueError: A shape does not match, or a pose does not exist.
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
    """Render a sky for a camera: 0.5 + harmonics along the ray of each pixel, clamped to [0, 1].

    Args:
        sh: Coefficients over world directions. [K, 3]
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
    from . import compilation
    from .cpu import sky

    rays = camera.T_cam_world[:3, :3].T @ np.linalg.inv(camera.intrinsics)
    image = np.empty((camera.height, camera.width, 3), np.float32)
    compilation.run(sky.draw_sky, camera.height // _ROWS_WORTH_A_THREAD, np.ascontiguousarray(rays), sh, image)
    return image


class _Poses:
    """Eyes [P, 3] and maps [P, 3, 3], float64, and the pose of each Gaussian: [N], or [0] if all use the first."""

    def __init__(self, eyes: np.ndarray, view_maps: np.ndarray | None, pose_ids: Any, n: int):
        eyes = np.asarray(eyes, np.float64).reshape(-1, 3)
        maps = np.eye(3)[None] if view_maps is None else np.asarray(view_maps, np.float64).reshape(-1, 3, 3)
        count = max(len(eyes), len(maps))
        if not {len(eyes), len(maps)} <= {1, count}:
            raise ValueError(f"view_maps: expected one for each of {len(eyes)} eyes, got {len(maps)}")
        # Copies: contiguous and writable, so that the kernels compile for one array type, and independent of changes
        # that the caller makes before the backward pass.
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
    """Implement `seen_colors` in plain torch."""

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
        from . import compilation
        from .cpu import sh_kernels

        colors = np.empty((len(means), 3), np.float32)
        inputs = _kernel_inputs(means, sh, rest, factor, poses)
        compilation.run(sh_kernels.shade, len(means) // _WORTH_A_THREAD, *inputs, colors)
        ctx.save_for_backward(means, sh, rest, factor)
        ctx.poses = poses
        return torch.from_numpy(colors)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, d_colors):
        from . import compilation
        from .cpu import sh_kernels

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
    """Arguments of both kernels, in their order."""
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
