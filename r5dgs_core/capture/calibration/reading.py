"""Detection and reading of calibrations."""

from __future__ import annotations

from pathlib import Path

from ... import errors
from .calibration import Calibration
from .formats import registry


def find_calibration(path: Path) -> Path | None:
    """Return the file or folder of the calibration at or directly in a path, or None."""
    found = registry.find(Path(path))
    return None if found is None else found[1]


def read_calibration(path: Path) -> Calibration:
    """Read the calibration at a path: a file, or the folder that holds it. The format is detected.

    Raises:
        DatasetError: The path has no calibration in a known format, or the calibration is damaged.
    """
    path = Path(path)
    found = registry.find(path)
    if found is None:
        problem = "expected a calibration" if path.exists() else "the path does not exist; expected a calibration"
        raise errors.DatasetError(f"{path}: {problem}: {registry.known_files()}")
    module, file = found
    return module.read(file)
