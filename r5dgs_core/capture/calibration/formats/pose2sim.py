"""Pose2Sim's ``Calib*.toml``: anipose's layout (`anipose`) with metres as unit and a world with z up."""

from __future__ import annotations

from pathlib import Path

from ..calibration import Calibration
from . import anipose

FILES = "Calib*.toml"


def detect(path: Path) -> Path | None:
    """Return the calibration file of a path, or None; in a folder, the only file ``Calib*.toml``."""
    if path.is_dir():
        found = sorted(file for file in path.glob(FILES) if file.is_file())
        return found[0] if len(found) == 1 else None
    return path if path.match(FILES) and path.is_file() else None


def read(path: Path) -> Calibration:
    """Read the cameras. Raises DatasetError if the file is damaged."""
    return Calibration(anipose.read_cameras(path), 1.0, "pose2sim", path, world_convention="blender")
