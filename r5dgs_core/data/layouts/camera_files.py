"""Layout with camera files ``transforms_{train,val,test}.json`` (`transforms`) and images beside them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import errors, findings
from .raw_dataset import RawDataset
from .registry import CAMERAS_FILE

if TYPE_CHECKING:  # a layout is detected before numpy is imported
    import numpy as np

    from ..transforms import Entry

REMEDY = "prepare the data set again or remove it"
POINTS = "points.npy"  # points and colours of a reconstruction, world and sRGB in [0, 1]: [P, 6]


def detect(root: Path) -> bool:
    """Return True if the folder has a camera file of training views."""
    return (root / CAMERAS_FILE).exists()


def read(root: Path, min_registered: float = 0.0, guard: findings.Guard = findings.STRICT) -> RawDataset:
    """Read the camera files. A split without a file is empty, and keys of earlier splits take precedence.

    Args:
        root: Folder of the data set.
        min_registered: Not used.
        guard: Entered around each file and each frame.

    Raises:
        DatasetError: A file is damaged.
    """
    from .. import transforms

    entries: dict[str, list[Entry]] = {"train": [], "val": [], "test": []}
    header: dict[str, Any] = {}
    files = []
    for split in entries:
        path = root / f"transforms_{split}.json"
        if path.exists():
            with guard():
                entries[split], top = transforms.read(path, guard)
                header = {**top, **header}
            files.append(path)
            with guard():
                transforms.check_perspective(path, header)
    points = None
    if (root / POINTS).exists():
        with guard():
            points = _points(root / POINTS)
        files.append(root / POINTS)
    if points is None:
        return RawDataset(entries, header, root, tuple(files))
    return RawDataset(entries, header, root, tuple(files), points[:, :3], points[:, 3:].astype("float32"))


def _points(path: Path) -> np.ndarray:
    """Read points and colours. [P, 6] float64"""
    import numpy as np

    from .. import array_file

    with findings.coded("D25"):
        points = array_file.read(path, 6, REMEDY)
        if not np.isfinite(points).all():
            raise errors.DatasetError(f"{path}: expected finite numbers; {REMEDY}")
    return points
