"""Compilation of the rasterizer's kernels on the CPU ahead of use, or loading from an earlier process's cache."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from ..raster import backends, rasterizer, shade
from ..raster.arrays import Array, like
from ..raster.settings import RasterSettings
from ..scene.cameras import Camera

_VIEW = Camera(4, 4, np.array([[4.0, 0, 2], [0, 4, 2], [0, 0, 1]]), np.eye(4))
_ROW = np.ones((1, 3), np.float32)
_SH = 4  # coefficients: degree 1, the lowest with kernels


def warm_up(gradients: bool = True, progress: Callable[[str], object] | None = None) -> float:
    """Compile or load all kernels of the fastest backend on the CPU.

    The first call after installation takes 10 to 30 s; in later processes it takes less than 1 s.

    Args:
        gradients: True to include the kernels that only training needs.
        progress: Called with the name of each stage before it begins.

    Returns:
        Elapsed time in seconds.
    """
    start = time.perf_counter()
    for name, stage in _stages(gradients):
        if progress is not None:
            progress(name)
        stage()
    return time.perf_counter() - start


def count(gradients: bool = True) -> int:
    """Number of stages of `warm_up`."""
    return len(_stages(gradients))


def _stages(gradients: bool) -> list[tuple[str, Callable[[], object]]]:
    stages: list[tuple[str, Callable[[], object]]] = [
        *(("splats", _splats), ("static layer", _static_layer)),
        *(("colors", _colors), ("sky", _sky), ("meshes", _meshes)),
    ]
    if gradients:
        stages += [
            *(("weights of segments", _segment_weights), ("gradients of splats", _splat_gradients)),
            ("gradients of colors", _color_gradients),
        ]
    return stages


def _inputs(row: Array) -> tuple[Array, Array, Array, Array, Array]:
    return row, like(np.ones((1, 4), np.float32), row), row, row[:, 0], row


def _draw(row: Array) -> Array:
    labels = like(np.zeros(1, np.int32), row)
    return rasterizer.rasterize_splats(*_inputs(row), _VIEW, labels=labels).image


def _shade(row: Array) -> Array:
    return shade.seen_colors(row, like(np.ones((1, _SH, 3), np.float32), row), np.zeros(3))


def _splats() -> None:
    _draw(_ROW)


def _static_layer() -> None:
    backend = backends.on_cpu()
    if backend.has_static_layer:
        still = moving = _inputs(_ROW)
        backend.static_layer(*still, _VIEW).draw(*moving)


def _segment_weights() -> None:
    from . import segment_weights  # imports scipy, which is slow

    segments = np.zeros((_VIEW.height, _VIEW.width), np.int64)
    segment_weights.segment_weights(*_inputs(_ROW)[:4], _VIEW, segments, 1)


def _colors() -> None:
    _shade(_ROW)


def _sky() -> None:
    shade.sky(np.zeros((_SH, 3)), _VIEW)


def _meshes() -> None:
    backend = backends.on_cpu()
    if backend.has_static_layer:  # its kernels are used
        from . import front_layer, mesh_depths, posed_scene  # import numba

        row, turn = np.ones((1, 1, 3), np.float32), np.array([[1, 0, 0, 0]], np.float32)
        zero = np.zeros(1, np.int32)
        posed = posed_scene.PosedScene(row[0], turn, row[0], row[0, :, 0], row, zero, np.eye(3)[None], zero, None)
        depths = mesh_depths.draw(_VIEW, np.eye(3), np.arange(3)[None], 0.1)
        front_layer.render(posed, _VIEW, depths, RasterSettings())


def _splat_gradients() -> None:
    _differentiate(_draw)


def _color_gradients() -> None:
    _differentiate(_shade)


def _differentiate(draw: Callable[[Array], Array]) -> None:
    import torch

    with torch.inference_mode(False), torch.enable_grad():  # independent of the caller's grad mode
        draw(torch.ones(1, 3, requires_grad=True)).sum().backward()
