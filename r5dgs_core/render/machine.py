"""Package versions and machine, on which timings and the last bits of results depend."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..raster import thread_pool


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that affect results."""
    import numba
    import OpenImageIO as oiio
    import torch

    return {
        "r5dgs": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "numba": numba.__version__,
        "openimageio": oiio.VERSION_STRING,
    }


def describe() -> dict[str, Any]:
    """Description of the machine: system, processor, cores, threads and GPU."""
    import torch

    processor = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        processor = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), processor)
    except OSError:
        pass  # no procfs on this system
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "system": platform.platform(),
        "processor": processor,
        "cores": usable,
        "raster_threads": thread_pool.threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }
