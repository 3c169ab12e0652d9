"""Registry of the rasterizer backends, and selection of one for given inputs on this machine."""

from __future__ import annotations

import functools
import importlib
import logging

import numpy as np

from .. import errors
from .arrays import Array, device_of
from .backend import Backend

log = logging.getLogger(__name__)

# Module of this room that defines `BACKEND`, by the backend's name. Fastest first: "auto" takes the first that suits
# the inputs and is available.
MODULES = {
    "cpu": "cpu.backend",
    "cuda": "cuda",
    "reference": "reference",
}


def choose(name: str, like: Array) -> Backend:
    """Return the backend of that name, or the fastest if "auto", for inputs of the device and dtype of ``like``.

    Raises:
        ValueError: The name is unknown.
        BackendError: The backend cannot rasterize these inputs here.
    """
    if name == "auto":
        return _fastest(like)
    if name not in MODULES:
        raise ValueError(f"backend: expected one of {', '.join(['auto', *MODULES])}, got {name!r}")
    found = _load(name, like)
    reason = found.why_unavailable(like)
    if reason is not None:
        raise errors.BackendError(f"rasterizer '{name}': {reason}")
    return found


def on_cpu() -> Backend:
    """Return the fastest backend for float32 arrays."""
    return _fastest(np.empty(0, np.float32))


class _Missing(Backend):
    """Stand-in for a backend whose module needs a package that is not installed."""

    def __init__(self, package: str):
        self._package = package

    def why_unavailable(self, like: Array) -> str:
        return f"{self._package} is not installed; remedy: pip install {self._package}"


def _load(name: str, like: Array) -> Backend:
    """Import a backend, and return it for inputs of this kind."""
    try:
        module = importlib.import_module(f".{MODULES[name]}", __package__)
    except ModuleNotFoundError as error:
        return _Missing((error.name or name).partition(".")[0])
    return module.BACKEND.for_inputs(like)


def _fastest(like: Array) -> Backend:
    missing = []
    for name in MODULES:
        backend = _load(name, like)
        if not backend.suits(like):
            continue
        reason = backend.why_unavailable(like)
        if reason is None:
            for other, why in missing:
                _warn_once(f"rasterizer: using the slower '{name}', as '{other}' is not available: {why}")
            return backend
        missing.append((name, reason))
    reasons = "; ".join(f"'{name}': {why}" for name, why in missing) or "none of them supports it"
    raise errors.BackendError(f"rasterizer: no backend for {like.dtype} on {device_of(like)}: {reasons}")


@functools.cache
def _warn_once(message: str) -> None:
    log.warning(message)
