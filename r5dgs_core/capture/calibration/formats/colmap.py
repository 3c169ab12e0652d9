"""COLMAP's reconstructions, binary or text, with every camera model except panoramas.

Poses are world to camera with OpenCV axes, and the first pixel's centre is at 0.5. The unit of the world is free.
Images are in `images/` beside `sparse/`; `times.json` beside them may give their times.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ....data import colmap_dataset, colmap_model
from ....data.layouts import colmap as layout
from ..calibration import Calibration
from ..lens import Lens
from . import shots
from .shots import Shot

FILES = "sparse/0/cameras.bin or .txt"
_PLACES = ("", "colmap")  # folders that hold `sparse`


def detect(path: Path) -> Path | None:
    """Return the folder of the reconstruction of a path, or None."""
    if path.name in ("cameras.bin", "cameras.txt") and path.is_file():
        return path.parent
    if not path.is_dir():
        return None
    if any((path / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
        return path
    return next((found for place in _PLACES if (found := layout.reconstruction(path / place)) is not None), None)


def read(path: Path) -> Calibration:
    """Read the cameras, images and points of a reconstruction. Raises DatasetError if a file is damaged."""
    model = colmap_model.read(path)
    root = next((parent for parent in path.parents if (parent / colmap_dataset.IMAGES).is_dir()), path.parent)
    times = {}
    if (root / "times.json").is_file():
        times, _ = colmap_dataset.read_times(root / "times.json")
    found = [
        Shot(
            camera="",
            path=root / colmap_dataset.IMAGES / image.name,
            time=times.get(image.name),
            size=(image.lens.width, image.lens.height),
            lens=lens_of(image.lens),
            camera_to_world=np.linalg.inv(image.T_cam_world),
        )
        for image in model.images
    ]
    return Calibration(shots.cameras(found), None, "colmap", path, points=model.points, colors=model.colors)


def lens_of(lens: colmap_model.Lens) -> Lens:
    """Convert a lens of COLMAP."""
    name, coefficients = _distortion(lens.model, lens.coefficients)
    return Lens(name, lens.fx, lens.fy, lens.cx, lens.cy, coefficients)


def _distortion(model: str, coefficients: tuple[float, ...]) -> tuple[str, tuple[float, ...]]:
    if model in colmap_model.PINHOLES:
        return "pinhole", ()
    if model in ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"):
        return "brown", (*coefficients, *[0.0] * (4 - len(coefficients)))
    name = {
        "FOV": "field_of_view",
        "THIN_PRISM_FISHEYE": "thin_prism_fisheye",
        "RAD_TAN_THIN_PRISM_FISHEYE": "project_aria",
        "SIMPLE_DIVISION": "division",
        "DIVISION": "division",
        "EUCM": "extended_unified",
    }
    return name.get(model, "fisheye"), coefficients
