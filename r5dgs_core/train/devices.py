"""Selection of the device that a run trains on."""

from __future__ import annotations

import logging
import os

import torch

from ..errors import BackendError
from ..raster import cuda

log = logging.getLogger(__name__)

AUTO, CPU = "auto", "cpu"


def select(name: str) -> torch.device:
    """Return the device of a name: ``cpu``, ``cuda``, ``cuda:N``, or ``auto``.

    ``auto`` is a CUDA device if torch finds one and gsplat can be loaded, and otherwise the CPU. Of several processes
    that train together, each takes its own CUDA device for ``cuda`` and ``auto``; others take the first one. A CUDA
    device becomes the current one, on which graphs are captured.

    Raises:
        BackendError: The named device cannot be used; the message has the remedy.
    """
    if name == CPU:
        return torch.device(CPU)
    device = (
        torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0"))) if name in (AUTO, "cuda") else torch.device(name)
    )
    if torch.version.cuda is not None and torch.cuda.is_available():
        count, index = torch.cuda.device_count(), device.index or 0
        if index >= count:
            remedy = f"--nproc-per-node {count}" if name in (AUTO, "cuda") else f"--device cuda:{count - 1}"
            raise BackendError(f"device {name}: torch finds {count} CUDA devices; remedy: {remedy}")
        device = torch.device("cuda", index)
    reason = cuda.why_unavailable(device, torch.float32)
    if reason is None:
        torch.cuda.set_device(device)
        return device
    if name != AUTO:
        raise BackendError(f"device {name}: {reason}".replace("backend='cpu'", "--device cpu"))
    log.info("training on the CPU: %s", reason)
    return torch.device(CPU)


def title(device: torch.device) -> str:
    """Return a device's name for messages: "CPU", or the name of the GPU."""
    return "CPU" if device.type == CPU else f"{torch.cuda.get_device_name(device)} ({device})"
