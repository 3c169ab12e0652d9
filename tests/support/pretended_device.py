"""A pretended device: tensors in CPU memory that report another device and follow the rules of a GPU.

Operations that mix them with tensors of the CPU fail. Operations that make a processor wait for a GPU, because they
read values or copy to or from the host without ``non_blocking``, are recorded with the line that caused them. Values
are computed by the CPU, so results can be compared bit for bit with a run on the CPU that uses the same code
(`twins`).
"""

import contextlib
import dataclasses
import traceback
from collections import Counter

import numpy as np
import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import return_and_correct_aliasing

from r5dgs_core.raster import arrays, backends, cuda, cuda_projection, rasterizer, shade
from r5dgs_core.train import losses, step_graphs
from tests.support import gsplat_stand_in

DEVICE = torch.device("cuda", 0)
aten = torch.ops.aten
# Operations whose results a processor must wait for.
WAITS = {
    aten._local_scalar_dense,
    aten.nonzero,
    aten.masked_select,
    aten._unique2,
    aten.unique_dim,
    aten.unique_consecutive,
    aten.bincount,
    aten.repeat_interleave,
    aten.equal,
    aten._linalg_svd,
    aten._linalg_eigh,
    aten.linalg_inv,
}
INDEXED = {aten.index, aten.index_put, aten.index_put_, aten._index_put_impl_}  # wait for masks


class OnDevice(torch.Tensor):
    """A tensor on the pretended device, around a tensor in CPU memory."""

    @staticmethod
    def __new__(cls, inner):
        return torch.Tensor._make_wrapper_subclass(
            cls, inner.shape, strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype
        )

    def __init__(self, inner):
        self.inner = inner

    device = property(lambda self: DEVICE)
    __torch_function__ = torch._C._disabled_torch_function_impl

    def __repr__(self):
        return f"OnDevice({self.inner})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        given = [t for t in pytree.tree_leaves((args, kwargs)) if isinstance(t, torch.Tensor)]
        name = func.overloadpacket
        if name is aten.copy_:
            if isinstance(args[0], cls) != isinstance(args[1], cls) and not (
                len(args) > 2 and args[2] and not _every_copy[0]
            ):
                _record(name)
        elif any(not isinstance(t, cls) and t.dim() > 0 for t in given):
            raise RuntimeError(f"{name}: tensors on different devices: {[str(t.device) for t in given]} ({_place()})")
        masks = name in INDEXED and any(t is not None and t.dtype is torch.bool for t in args[1])
        if name in WAITS or masks:
            _record(name)
        if kwargs.get("device") is not None:
            kwargs["device"] = torch.device("cpu")
        found = func(*_inner(args), **_inner(kwargs))
        if name is aten._local_scalar_dense:
            return found
        if name is aten.copy_ and not isinstance(args[0], cls):
            return args[0]
        return return_and_correct_aliasing(func, args, kwargs, pytree.tree_map_only(torch.Tensor, cls, found))


def _inner(tree):
    return pytree.tree_map_only(OnDevice, lambda t: t.inner, tree)


def to_host(tensor):
    """Return the values of a tensor of either kind, without a record."""
    return tensor.inner if isinstance(tensor, OnDevice) else tensor


_records: list[Counter] = []


def _record(name):
    for counter in _records[-1:]:
        counter[f"{_place()}: {name}"] += 1


def _place():
    frames = [f for f in traceback.extract_stack() if "/r5dgs_core/" in f.filename]
    frame = frames[-1] if frames else traceback.extract_stack()[-4]
    return f"{frame.filename.rpartition('/r5dgs_core/')[2]}:{frame.lineno}"


@contextlib.contextmanager
def record():
    """Context that returns a counter of the operations in it that wait for the device."""
    _records.append(Counter())
    try:
        yield _records[-1]
    finally:
        _records.pop()


class _Device(TorchFunctionMode):
    """Carries out what names the device: factories, and copies between the host and the device."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        if func is torch.Tensor.to:
            return _moved(args[0], *args[1:], **kwargs)
        if func in (torch.Tensor.cpu, torch.Tensor.tolist, torch.Tensor.new_tensor) and isinstance(args[0], OnDevice):
            _record(func.__name__)
            found = func(args[0].inner.detach() if func is torch.Tensor.cpu else args[0].inner, *args[1:], **kwargs)
            return OnDevice(found) if func is torch.Tensor.new_tensor else found
        if kwargs.get("device") is not None and torch.device(kwargs["device"]).type == DEVICE.type:
            kwargs["device"] = torch.device("cpu")
            found = func(*args, **kwargs)
            if func in (torch.tensor, torch.as_tensor) and not isinstance(args[0], OnDevice):
                _record(func.__name__)
            needs = found.requires_grad
            return found if isinstance(found, OnDevice) else OnDevice(found.detach()).requires_grad_(needs)
        return func(*args, **kwargs)


def _moved(tensor, *args, **kwargs):
    """Implement `torch.Tensor.to`."""
    like = args[0] if args else kwargs.get("other")
    if isinstance(like, torch.Tensor):
        device, dtype = like.device, like.dtype
    else:
        names = [a for a in args if isinstance(a, torch.device | str)]
        device = torch.device(kwargs.pop("device", names[0] if names else tensor.device))
        kinds = [a for a in args if isinstance(a, torch.dtype)]
        dtype = kwargs.pop("dtype", kinds[0] if kinds else tensor.dtype)
    if isinstance(tensor, OnDevice) and _in_optimizer():
        return tensor  # the optimizer finds the device in C++, where it is the CPU
    there = device.type == DEVICE.type
    if there == isinstance(tensor, OnDevice):
        copy = kwargs.get("copy", False)
        return tensor.to(dtype, copy=copy) if dtype != tensor.dtype or copy else tensor
    if _every_copy[0] or not kwargs.get("non_blocking", False):
        _record("to")
    if tensor.requires_grad and torch.is_grad_enabled():
        raise RuntimeError(f"a copy between devices records gradients ({_place()})")
    return OnDevice(tensor.detach().to(dtype, copy=True)) if there else tensor.inner.detach().to(dtype, copy=True)


def _in_optimizer():
    return any("/torch/optim/" in f.filename for f in traceback.extract_stack(limit=5))


def _unrecorded(function):
    """A kernel: what happens inside stays on the device."""

    def kernel(*args, **kwargs):
        with record():
            return function(*args, **kwargs)

    return kernel


def _isect_tiles(means2d, radii, depths, *sizes):
    _, keys, pairs = gsplat_stand_in.isect_tiles(*(to_host(t) for t in (means2d, radii, depths)), *sizes)
    wrap = OnDevice if isinstance(means2d, OnDevice) else lambda t: t
    return None, wrap(keys), wrap(pairs)


def _isect_offset_encode(keys, *sizes):
    found = gsplat_stand_in.isect_offset_encode(to_host(keys), *sizes)
    return OnDevice(found) if isinstance(keys, OnDevice) else found


def _rasterize_to_pixels(means2d, conics, colors, opacities, width, height, tile, starts, pairs):
    starts, pairs = to_host(starts), to_host(pairs)
    return _Blend.apply(means2d, conics, colors, opacities, width, height, tile, starts, pairs)


class _Blend(torch.autograd.Function):
    """The stand-in's blending on tensors of either kind, as one operation."""

    @staticmethod
    def forward(ctx, means2d, conics, colors, opacities, *rest):
        ctx.wrap = OnDevice if isinstance(means2d, OnDevice) else lambda t: t
        with torch.enable_grad():
            ctx.leaves = [to_host(t).detach().requires_grad_() for t in (means2d, conics, colors, opacities)]
            ctx.found = gsplat_stand_in.STAND_IN.rasterize_to_pixels(*ctx.leaves, *rest)
        return tuple(ctx.wrap(t.detach().contiguous()) for t in ctx.found)

    @staticmethod
    def backward(ctx, *upstream):
        grads = torch.autograd.grad(ctx.found, ctx.leaves, [to_host(t) for t in upstream], allow_unused=True)
        return (*(None if g is None else ctx.wrap(g) for g in grads), *[None] * 5)


KERNELS = dataclasses.replace(
    gsplat_stand_in.STAND_IN,
    isect_tiles=_unrecorded(_isect_tiles),
    isect_offset_encode=_unrecorded(_isect_offset_encode),
    rasterize_to_pixels=_unrecorded(_rasterize_to_pixels),
    fully_fused_projection=_unrecorded(gsplat_stand_in.fully_fused_projection),
)


class RepeatedWork:
    """A stand-in for a CUDA graph: repeats the work, and records copies from and to the host in it."""

    def __init__(self, work, pool):
        self._work = work

    def replay(self):
        with every_copy():
            self._work()


_every_copy = [False]


@contextlib.contextmanager
def every_copy():
    """Context in which copies with ``non_blocking`` are recorded, too; a CUDA graph cannot contain them."""
    _every_copy[0] = True
    try:
        yield
    finally:
        _every_copy[0] = False


CACHES = (cuda_projection._matrices, losses._window)


@contextlib.contextmanager
def twins():
    """Context in which tensors on the CPU are processed by the code for a GPU, with a stand-in for gsplat."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (arrays, rasterizer, shade):
            patch.setattr(module, "takes_kernels", lambda values: isinstance(values, np.ndarray))
        patch.setattr(step_graphs, "CapturedWork", RepeatedWork)
        patch.setattr(torch.cuda, "graph_pool_handle", lambda: ())
        patch.setattr(backends, "choose", lambda name, like: cuda.BACKEND.for_inputs(like))
        patch.setattr(cuda, "find_kernels", lambda: KERNELS)
        for cache in CACHES:
            cache.cache_clear()
        yield
        for cache in CACHES:
            cache.cache_clear()


@contextlib.contextmanager
def mode():
    """Context in which the device exists."""
    torch.__future__.set_overwrite_module_params_on_conversion(True)  # networks cannot change the kind of a tensor
    try:
        with twins(), _Device():
            yield
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(False)
