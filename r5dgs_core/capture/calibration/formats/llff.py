"""LLFF's ``poses_bounds.npy``, which Neu3D and DyNeRF use for one row per camera.

A row of 17 numbers is a 3 x 5 matrix and two depths. Its columns are the camera's axes down, right, backwards in the
world, its centre, and height, width and focal length in pixels; the principal point is the image's centre. The unit of
the world is free. Rows follow the sorted names of the videos, of the folders of frames, or of the images in `images/`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .... import errors
from ....data import array_file, file_kinds, images
from ..calibration import CalibratedCamera, CalibratedFrame, Calibration
from ..lens import Lens
from . import numbers

FILES = "poses_bounds.npy"


def detect(path: Path) -> Path | None:
    """Return the calibration file of a path, or None."""
    path = path / FILES if path.is_dir() else path
    return path if path.name == FILES and path.is_file() else None


def read(path: Path) -> Calibration:
    """Read the cameras. Raises DatasetError if the file is damaged, or the rows do not fit the files beside it."""
    table = array_file.read(path, 17)
    if not len(table):
        raise errors.DatasetError(f"{path}: expected rows of 17 numbers, found none; copy it again")
    if not np.isfinite(table).all():
        raise errors.DatasetError(f"{path}: expected finite numbers in row {int(np.argmin(np.isfinite(table).all(1)))}")
    files = _files(path, len(table))
    cameras = []
    for index, (row, file) in enumerate(zip(table, files, strict=True)):
        place = f"{path}: row {index}"
        down, right, back, center, (height, width, focal) = row[:15].reshape(3, 5).T
        if focal <= 0:
            raise errors.DatasetError(f"{place}: expected a focal length above 0, found {focal:g}")
        size = numbers.side(place, float(width)), numbers.side(place, float(height))
        lens = Lens("pinhole", float(focal), float(focal), size[0] / 2, size[1] / 2)
        pose = numbers.pose_of_center(place, np.stack([right, down, -back], 1), center)
        frames = (CalibratedFrame(file, None, lens, pose),) if file and file.suffix.lower() in images.SUFFIXES else ()
        cameras.append(CalibratedCamera(file.stem if file else f"cam{index:02d}", *size, lens, pose, frames))
    numbers.unique(path, (camera.name for camera in cameras))
    return Calibration(tuple(cameras), None, "llff", path)


def _files(path: Path, count: int) -> list[Path] | list[None]:
    """Return the videos, folders or images that the rows belong to, sorted by name, or None for each row."""
    beside = sorted(file for file in path.parent.iterdir() if not file.name.startswith("."))
    videos = [file for file in beside if file.suffix.lower() in file_kinds.VIDEOS]
    folders = [folder for folder in beside if folder.is_dir() and folder.name.lower().startswith("cam")]
    place = path.parent / "images"
    stills = [
        file for file in sorted(place.iterdir() if place.is_dir() else []) if file.suffix.lower() in images.SUFFIXES
    ]
    for kind, found in (("videos", videos), ("folders of frames", folders), ("images", stills)):
        if len(found) == count:
            return found
        if found:
            raise errors.DatasetError(
                f"{path}: expected as many rows as {kind}, found {count} rows and {len(found)} {kind}; remove the "
                f"{kind} without a row, or the rows without a video"
            )
    return [None] * count
