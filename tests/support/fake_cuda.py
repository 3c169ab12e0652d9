"""Tensors on a CUDA device that does not exist: shapes, dtypes and devices of a computation, without values.

Operations that mix devices fail as on a GPU. Random draws on the CPU keep their values, because the curriculum and the
field branch on them. torch without CUDA lacks two parts that autograd needs, which are replaced: the guard of the
device, and the engine of the backward pass.
"""

import contextlib
import ctypes
import heapq
import itertools
from pathlib import Path

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode, unset_fake_temporarily

from r5dgs_core.raster import cuda, cuda_projection
from r5dgs_core.train import losses

DEVICE = torch.device("cuda", 0)
PAIRS = 1000  # pairs of tile and Gaussian, which only values determine


def isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height):
    """Return some pairs."""
    return None, means2d.new_empty(PAIRS, dtype=torch.int64), radii.new_empty(PAIRS)


def isect_offset_encode(keys, images, tile_width, tile_height):
    """Return the first pair of each tile."""
    return keys.new_empty((images, tile_height, tile_width), dtype=torch.int32)


def rasterize_to_pixels(means2d, conics, colors, opacities, width, height, tile_size, starts, pairs):
    """Return an image that depends on all inputs."""
    assert {t.device for t in (means2d, conics, colors, opacities, starts, pairs)} == {DEVICE}
    everything = means2d.sum() + conics.sum() + opacities.sum() + colors.sum()
    return everything.expand(1, height, width, colors.shape[-1]), everything.expand(1, height, width, 1)


def fully_fused_projection(means, covars, quats, scales, views, lenses, width, height, **settings):
    """Return numbers that depend on all inputs."""
    assert {t.device for t in (means, quats, scales, views, lenses, settings["opacities"])} == {DEVICE}
    one = means + scales + quats[:, 1:]
    radii = torch.zeros_like(means[:, :2], dtype=torch.int32)
    return radii[None], one[None, :, :2], one[None, :, 2], one[None], None


FUNCTIONS = (isect_tiles, isect_offset_encode, rasterize_to_pixels, fully_fused_projection)
KERNELS = cuda.Kernels(*FUNCTIONS, "1.6.0", 1 / 255, 0.99, 1e-4)
DRAWS = ("rand", "randn", "randint", "randperm")


def _really(draw):
    def drawn(*sizes, **options):
        with unset_fake_temporarily():
            return draw(*sizes, **options)

    return drawn


def install_guard():
    """Install torch's guard that does nothing as the guard of CUDA devices, if torch is built without one.

    torch installs it only in place of a guard that finds no device, so such a guard is made up first.
    """
    library = ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / "libc10.so"))
    guards = (ctypes.c_void_p * 2).in_dll(library, "_ZN3c104impl26device_guard_impl_registryE")  # CPU, CUDA
    if guards[1]:
        return
    none_found = ctypes.CFUNCTYPE(ctypes.c_int)(lambda: 0)
    methods = (ctypes.c_void_p * 64)(*[ctypes.cast(none_found, ctypes.c_void_p).value] * 64)
    guard = (ctypes.c_void_p * 1)(ctypes.addressof(methods))
    guards[1] = ctypes.addressof(guard)
    torch._C._ensureCUDADeviceGuardSet()
    assert guards[1] != ctypes.addressof(guard)


@torch.no_grad()
def backward(loss):
    """Run the backward pass node by node, as the engine does, but without hooks."""
    order = itertools.count()
    waiting = {loss.grad_fn: {0: torch.ones_like(loss)}}
    queue = [(0, next(order), loss.grad_fn)]
    while queue:
        node = heapq.heappop(queue)[2]
        given = waiting.pop(node)
        run = node.apply if isinstance(node, torch.autograd.function.BackwardCFunction) else node
        found = run(*[given.get(k) for k in range(len(node._input_metadata))])
        found = found if isinstance(found, tuple) else (found,)
        for (following, index), grad in zip(node.next_functions, found, strict=False):
            if following is None or grad is None:
                continue
            grad = grad.sum_to_size(following._input_metadata[index].shape)
            if following not in waiting:
                waiting[following] = {}
                number = following._sequence_nr()
                heapq.heappush(queue, (1 if number >= 1 << 62 else -number, next(order), following))
            known = waiting[following].get(index)
            waiting[following][index] = grad if known is None else known + grad


@contextlib.contextmanager
def mode():
    """Context in which `DEVICE` exists, and the rasterizer for it is available."""
    install_guard()
    caches = (cuda_projection._matrices, losses._window)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cuda, "find_kernels", lambda: KERNELS)
        patch.setattr(cuda, "why_unavailable", lambda device, dtype: None)
        for name in DRAWS:
            patch.setattr(torch, name, _really(getattr(torch, name)))
        patch.setattr(torch.Tensor, "backward", backward)
        for cache in caches:
            cache.cache_clear()
        try:
            with FakeTensorMode(allow_non_fake_inputs=True) as fake:
                yield fake
        finally:
            for cache in caches:
                cache.cache_clear()
