"""The origin of a data set: the point of its world from which everything is measured after reading.

float32 has 24 bits: at a distance of 5e6 it resolves half a unit. If cameras stand that far from the world's origin,
compared with their distance from each other, positions are taken relative to a point among them, in float64.
"""

from __future__ import annotations

import math

import numpy as np

from .. import errors
from ..scene import cameras

FAR = 256.0  # distance from the world's origin, in spreads of the cameras, up to which that is the origin
SMALLEST, LARGEST = 1e-25, 1e13  # units between cameras; scenes hold coordinates up to `cameras.FARTHEST`
RESOLUTION = 1e-6  # of the spread; float64 has to resolve that where the cameras are
LONE = 4.0  # spread of cameras that all stand at one place, as `train.normalization` takes it


def find(
    centers: np.ndarray,  # [C, 3]
    place: str,
) -> np.ndarray:  # [3]
    """Find the point that positions are taken relative to.

    Args:
        centers: Positions of the cameras in the world of the files, float64.
        place: Names the data set in errors.

    Returns:
        The origin: zero for cameras near the world's, else a point among them with few decimal digits. float64

    Raises:
        DatasetError: The cameras are so far away that float64 cannot tell where they stand.
    """
    largest = float(np.abs(centers).max())
    if largest > cameras.FARTHEST:
        raise errors.DatasetError(
            f"{place}: expected cameras within {cameras.FARTHEST:g} units of the world's origin, found {largest:.3g}. "
            "Remedy: subtract a constant from all positions in the camera files, or scale all positions"
        )
    middle = np.median(centers, axis=0)
    away = float(np.abs(middle).max())
    distances = np.linalg.norm(centers - middle, axis=1)
    distances = distances[distances > 4 * np.spacing(away)]
    spread = float(np.median(distances)) if len(distances) else LONE
    if not SMALLEST <= spread <= LARGEST:
        raise errors.DatasetError(
            f"{place}: expected cameras that stand {SMALLEST:g} to {LARGEST:g} units apart, found {spread:.3g}. "
            "Remedy: scale all positions in the camera files to another unit"
        )
    if away <= FAR * spread:
        return np.zeros(3)
    if np.spacing(away) > RESOLUTION * spread:
        raise errors.DatasetError(
            f"{place}: the cameras stand {spread:.3g} units apart but {away:.3g} units from the world's origin: not "
            "even 64-bit numbers tell their places apart. Remedy: subtract a constant from all positions in the camera "
            "files where they are made, before they are rounded"
        )
    digits = -math.floor(math.log10(spread))
    return np.array([round(float(value), digits) for value in middle]) + 0.0  # one zero: -0.0 has other bytes
