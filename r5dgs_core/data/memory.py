"""Memory of the machine, and of the training images."""

from __future__ import annotations

import os
from pathlib import Path

from .. import errors
from .dataset import Dataset

_BYTES_PER_PIXEL = 3  # of an image in memory; masks are not counted
_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
_UNKNOWN = 8 * 2.0**30  # assumed on systems that do not report it


def total() -> float:
    """Return the memory of this machine, or of the control group that limits this process; bytes."""
    found = [_UNKNOWN]
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        found = [float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))]
    return min([*found, *(number for path in _LIMITS if (number := _number(Path(path))) is not None)])


def available() -> float | None:
    """Return the memory that new processes can use without swapping, bytes; None if the system does not report it."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        kib = next(line.split()[1] for line in lines if line.startswith("MemAvailable:"))
        return min(float(kib) * 1024, total())
    except (OSError, StopIteration, ValueError):
        return None


def of_images(dataset: Dataset) -> int:
    """Return the memory of the training images, bytes."""
    return sum(_BYTES_PER_PIXEL * view.camera.width * view.camera.height for view in dataset.train)


def check_images(dataset: Dataset) -> None:
    """Raise `DatasetError` if the training images alone do not fit into the available memory."""
    needed, free = of_images(dataset), available()
    if free is not None and needed > free:
        raise errors.DatasetError(
            f"{dataset.root}: its {len(dataset.train)} training images need {needed / 2**30:.1f} GB of memory, "
            f"{free / 2**30:.1f} GB are available. Remedy: prepare the data with a smaller --size or with --every N, "
            "scale the images down, or stop other programs"
        )


def _number(path: Path) -> float | None:
    try:
        text = path.read_text().strip()
    except OSError:
        return None
    return float(text) if text.isdigit() else None
