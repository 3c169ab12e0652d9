"""Colours from spherical harmonics: view-dependent colours of Gaussians, differentiable, and skies.

Degree 0 does not depend on the direction, and is the same for all backends.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..scene import spherical_harmonics
from ..scene.cameras import Camera
from . import backends
from .arrays import Array, array_namespace, like, takes_kernels, to_host
from .backend import ViewPoses


def seen_colors(
    means: Array,  # [N, 3]
    sh: Array,  # [N, K, 3] or [N, 1, 3]
    eyes: Array,  # [3] or [P, 3]
    *,
    rest: Array | None = None,  # [N, K - 1, 3]
    view_maps: np.ndarray | None = None,  # [P, 3, 3]
    pose_ids: Any = None,  # [N]
    factor: Array | None = None,  # [N]
    backend: str = "auto",
) -> Array:
    """Return the display-referred colour of each Gaussian: factor * max(0, 0.5 + harmonics along the line of sight).

    Differentiable in means, coefficients and factor. A Gaussian at the eye has its degree-0 colour. Clamped colours
    have zero gradient.

    Args:
        means: Centres. [N, 3]
        sh: Coefficients in the order of `spherical_harmonics.basis`; only those of degree 0 if ``rest`` is given.
        eyes: Eye of each pose in the frame of ``means``, or one for all, array or tensor. [P, 3] or [3]
        rest: Coefficients of degree 1 and higher. [N, K - 1, 3]
        view_maps: Linear map of each pose from directions to the frame of the coefficients; the result is normalised.
            None for the identity. [P, 3, 3]
        pose_ids: Pose of each Gaussian; None for the first. [N] integers, array or tensor
        factor: Factor on the colour; 1 if None. [N]
        backend: As for `rasterizer.rasterize_splats`.

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
    if spherical_harmonics.degree_of(count) == 0:
        colors = array_namespace(sh).clip(spherical_harmonics.dc_to_rgb(sh[:, 0]), 0, None)
        return colors if factor is None else colors * factor[:, None]
    poses = _poses(eyes, view_maps, pose_ids, n)
    return backends.choose(backend, means).seen_colors(means, sh, rest, factor, poses)


def sky(sh: np.ndarray, camera: Camera) -> np.ndarray:
    """Render a sky for a camera: 0.5 + harmonics along the ray of each pixel, clamped to [0, 1].

    Args:
        sh: Coefficients over world directions. [K, 3]
        camera: The camera.

    Returns:
        Display-referred sRGB. [H, W, 3] float32
    """
    sh = np.array(sh, np.float64)
    if spherical_harmonics.degree_of(len(sh)) == 0:
        color = np.clip(spherical_harmonics.dc_to_rgb(sh[0]), 0, 1)
        return np.broadcast_to(color.astype(np.float32), (camera.height, camera.width, 3))
    return backends.on_cpu().sky(sh, camera)


def _poses(eyes: Array, view_maps: np.ndarray | None, pose_ids: Any, n: int) -> ViewPoses:
    """Check and copy the arguments of `seen_colors` for ``n`` Gaussians; tensors on a GPU are used as they are."""
    if not takes_kernels(eyes):
        maps = array_namespace(eyes).eye(3, dtype=eyes.dtype, device=eyes.device)[None]
        if view_maps is not None:
            maps = like(np.asarray(view_maps).reshape(-1, 3, 3), eyes, eyes.dtype)
        count = max(len(eyes), len(maps))
        ids = np.empty(0, np.int64) if pose_ids is None else pose_ids
        return ViewPoses(eyes.expand(count, 3), maps.expand(count, 3, 3), ids)
    eyes = to_host(eyes)
    eyes = np.asarray(eyes, np.float64).reshape(-1, 3)
    maps = np.eye(3)[None] if view_maps is None else np.asarray(view_maps, np.float64).reshape(-1, 3, 3)
    count = max(len(eyes), len(maps))
    if not {len(eyes), len(maps)} <= {1, count}:
        raise ValueError(f"view_maps: expected one for each of {len(eyes)} eyes, got {len(maps)}")
    ids = np.empty(0, np.int64)
    if pose_ids is not None:
        ids = np.array(to_host(pose_ids), np.int64)
        if ids.shape != (n,) or (n and not 0 <= ids.min() <= ids.max() < count):
            raise ValueError(f"pose_ids: expected {n} rows of {count} poses, got {ids!r}")
    # Copies: contiguous and writable, so that the kernels compile for one array type, and independent of changes that
    # the caller makes before the backward pass.
    return ViewPoses(np.broadcast_to(eyes, (count, 3)).copy(), np.broadcast_to(maps, (count, 3, 3)).copy(), ids)
