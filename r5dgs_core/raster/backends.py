"""Selection of the rasterizer backend for given tensors on this machine."""

from __future__ import annotations

import functools
import importlib.util
import logging

import torch

from .. import errors
from . import cuda
from .settings import BACKENDS

log = logging.getLogger(__name__)


def choose_backend(backend: str, means: torch.Tensor) -> str:
    """Return the backend to use for tensors like ``means``, resolving "auto".

    Raises:
        ValueError: The name is unknown.
        BackendError: The backend cannot rasterize these tensors here.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend: expected one of {', '.join(BACKENDS)}, got {backend!r}")
    if backend == "auto":
        if means.device.type == "cpu" and means.dtype == torch.float32 and numba_is_there():
            return "cpu"
        if means.device.type == "cpu" and means.dtype == torch.float32:
            log.warning("rasterizer: numba is not installed, using the slow reference; remedy: pip install numba")
        if means.device.type == "cuda" and means.dtype == torch.float32:
            reason = cuda.obstacle(means.device, means.dtype)
            if reason is None:
                return "cuda"
            _warn_once(f"rasterizer: using the slow reference on the GPU, as backend 'cuda' is not available: {reason}")
        return "reference"
    if backend == "cuda":
        reason = cuda.obstacle(means.device, means.dtype)
        if reason is not None:
            raise errors.BackendError(f"rasterizer 'cuda': {reason}")
    if backend == "cpu":
        if not numba_is_there():
            raise errors.BackendError("rasterizer 'cpu': numba is not installed; remedy: pip install numba")
        if means.device.type != "cpu" or means.dtype != torch.float32:
            raise errors.BackendError(
                f"rasterizer 'cpu': expected float32 tensors on the CPU, got {means.dtype} on {means.device}; "
                "remedy: convert them, or use backend='reference'"
            )
    return backend


def numba_is_there() -> bool:
    """Return True if numba is installed. Does not import it."""
    return importlib.util.find_spec("numba") is not None


@functools.cache
def _warn_once(message: str) -> None:
    log.warning(message)
