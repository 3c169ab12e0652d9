"""Memory of the machine, and of the training images."""

from __future__ import annotations

import math
import os
from pathlib import Path

from .. import errors
from .dataset import Dataset

_BYTES_PER_PIXEL = 4  # of an image with its mask
_AT_ONCE = 32  # images that training needs at the same time, such as those of a camera for its background
_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
GB = 2.0**30
_UNKNOWN = 8 * GB  # assumed on systems that do not report it


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


def for_images(limit: float, processes: int = 1) -> float:
    """Return the memory that a process may use for pixels, bytes.

    Args:
        limit: Maximum, GB (``data.memory``).
        processes: Number of processes of this machine that train together; they share half of the available memory.
    """
    free = available()
    return limit * GB if free is None else min(limit * GB, free / 2 / processes)


def of_images(dataset: Dataset) -> int:
    """Return the memory of the pixels of all training images and masks, bytes."""
    return sum(_BYTES_PER_PIXEL * view.camera.width * view.camera.height for view in dataset.train)


def at_once(dataset: Dataset) -> int:
    """Return the memory of the pixels that training needs at the same time, bytes."""
    sizes = sorted((view.camera.width * view.camera.height for view in dataset.train), reverse=True)
    return _BYTES_PER_PIXEL * sum(sizes[:_AT_ONCE])


def check_images(dataset: Dataset, processes: int = 1) -> None:
    """Raise `DatasetError` if the images that training needs at the same time do not fit into the available memory.

    Args:
        dataset: The data set.
        processes: Number of processes of this machine that train together; each holds such images.
    """
    needed, free = processes * at_once(dataset), available()
    if free is not None and needed > free:
        several = processes > 1
        together, fewer = f" in each of {processes} processes" * several, "start fewer processes, " * several
        raise errors.DatasetError(
            f"{dataset.root}: training needs {needed / GB:.1f} GB of memory for {min(_AT_ONCE, len(dataset.train))} "
            f"images at the same time{together}, {free / GB:.1f} GB are available. Remedy: {fewer}prepare the data "
            "with a smaller --size, scale the images down, or stop other programs"
        )


def note(dataset: Dataset, limit: float, processes: int = 1) -> str:
    """Return a remark for the user if images are read again while training, else an empty string.

    Args:
        dataset: The data set.
        limit, processes: As for `for_images`.
    """
    needed, used = of_images(dataset), for_images(limit, processes)
    if needed <= used:
        return ""
    least = math.ceil(needed / GB)
    possible = needed <= for_images(least, processes)
    remedy = f"data.memory={least} keeps all of them" if possible else "all of them need more than half of what is free"
    return (
        f" ({len(dataset.train)} images of {needed / GB:.1f} GB are read again while training, because they may use "
        f"{used / GB:.1f} GB of memory; {remedy})"
    )


def _number(path: Path) -> float | None:
    try:
        text = path.read_text().strip()
    except OSError:
        return None
    return float(text) if text.isdigit() else None
