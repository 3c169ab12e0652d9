"""Compilation of the training and rasterizer kernels, or their loading from the cache."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

from ..model import group_poses
from ..render import warm_up as render_warm_up
from . import losses
from .representations import fused_posing


def warm_up(progress: Callable[[str], object] | None = None) -> float:
    """Compile or load all kernels of training, including those of the rasterizer.

    Args:
        progress: Called with the name of each stage before it starts.

    Returns:
        Seconds taken.

    Raises:
        BackendError: Numba is not installed.
    """
    start = time.perf_counter()
    render_warm_up.warm_up(progress=progress)
    for name, stage in (("poses", _poses), ("loss", _loss)):
        if progress is not None:
            progress(name)
        with torch.inference_mode(False), torch.enable_grad():
            stage()
    return time.perf_counter() - start


def _poses() -> None:
    row, quat, group = torch.ones(1, 3, requires_grad=True), torch.ones(1, 4), group_poses.at_rest(1)
    ids = torch.zeros(1, dtype=torch.int64)
    splats = fused_posing.pose(row, quat, row, torch.ones(1), row, row, torch.ones(3), ids, group, torch.zeros(1, 3))
    splats.means.sum().backward()


def _loss() -> None:
    losses.photometric(torch.ones(4, 4, 3, requires_grad=True), torch.zeros(4, 4, 3), 0.2).backward()
