"""Registry of the rasterizer backends, and selection of one for given tensors on this machine."""

from __future__ import annotations

import functools
import logging

import torch

from .. import errors
from .backend import Backend
from .cpu.backend import CpuBackend
from .cuda import CudaBackend
from .reference import ReferenceBackend

log = logging.getLogger(__name__)

# Fastest first: "auto" takes the first that suits the tensors and has no obstacle.
BACKENDS: list[Backend] = [
    CpuBackend(),
    CudaBackend(),
    ReferenceBackend(),
]


def choose(name: str, like: torch.Tensor) -> Backend:
    """Return the backend of that name, or the fastest if "auto", for tensors of the device and dtype of ``like``.

    Raises:
        ValueError: The name is unknown.
        BackendError: The backend cannot rasterize these tensors here.
    """
    if name == "auto":
        return _fastest(like)
    found = next((backend for backend in BACKENDS if backend.name == name), None)
    if found is None:
        known = ", ".join(["auto", *(backend.name for backend in BACKENDS)])
        raise ValueError(f"backend: expected one of {known}, got {name!r}")
    reason = found.obstacle(like)
    if reason is not None:
        raise errors.BackendError(f"rasterizer '{name}': {reason}")
    return found


def on_cpu() -> Backend:
    """Return the fastest backend for float32 tensors on the CPU."""
    return _fastest(torch.empty(0))


def _fastest(like: torch.Tensor) -> Backend:
    missing = []
    for backend in BACKENDS:
        if not backend.suits(like):
            continue
        reason = backend.obstacle(like)
        if reason is None:
            for name, why in missing:
                _warn_once(f"rasterizer: using the slower '{backend.name}', as '{name}' is not available: {why}")
            return backend
        missing.append((backend.name, reason))
    raise errors.BackendError(f"rasterizer: no backend for {like.dtype} on {like.device}: {missing}")


@functools.cache
def _warn_once(message: str) -> None:
    log.warning(message)
