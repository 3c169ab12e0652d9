"""Images with a COLMAP reconstruction, static or with a time per image.

All layouts contain ``sparse/0/{cameras,images,points3D}.{bin,txt}`` (or ``sparse/``):

- ``images/NAME``: every image is registered. Times come from ``times.json``; without it, all images have time 0.
- ``images/CAMERA/FRAME``: static cameras, each registered once, by one of its frames or by an image ``CAMERA`` beside
  the folders. Times come from ``times.json``, or from the numbers at the end of the frames' names, mapped to [0, 1].

``times.json`` maps images to times; beside "times" it may hold "t_max" (later views are the test split) and
"frames_per_unit".
"""

from __future__ import annotations

from pathlib import Path

from ... import errors, findings
from .raw_dataset import RawDataset

MIN_REGISTERED = 0.5  # minimum share of registered images; fewer mean a failed reconstruction


def detect(root: Path) -> bool:
    """Return True if the folder has a COLMAP reconstruction."""
    return reconstruction(root) is not None


def reconstruction(root: Path) -> Path | None:
    """Return the folder of the COLMAP reconstruction in a data set, or None if it has none."""
    for candidate in (root / "sparse" / "0", root / "sparse"):
        if any((candidate / f"cameras{suffix}").exists() for suffix in (".bin", ".txt")):
            return candidate
    return None


def read(root: Path, min_registered: float = MIN_REGISTERED, guard: findings.Guard = findings.STRICT) -> RawDataset:
    """Read cameras, times and points of a data set.

    If there are at least eight cameras, every eighth (by name, from the first) is held out, within the times that the
    other cameras observe: its other images are dropped, and a camera without images in that span is trained on. Views
    later than "t_max" of ``times.json`` are the test split.

    Args:
        root: Folder of the data set.
        min_registered: Minimum share of the images that must have a pose. Images missing in ``times.json`` do not
            count.
        guard: Entered around each image that may lack a pose or a time.

    Raises:
        DatasetError: A file is missing or damaged, too few images are registered, or a lens is distorted.
    """
    sparse = reconstruction(root)
    if sparse is None:
        raise errors.DatasetError(f"{root / 'sparse' / '0'}: expected a COLMAP reconstruction, found none", code="D14")
    from .. import colmap_dataset

    return colmap_dataset.read(root, sparse, min_registered, guard)
