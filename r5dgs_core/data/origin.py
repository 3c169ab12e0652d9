"""Origin of a data set: the point of its world that all positions are relative to after reading.

float32 has 24 bits: at a distance of 5e6 it resolves half a unit. If the cameras are that far from the files' origin,
compared with their spread, positions are taken relative to a point among them, in float64.
"""

from __future__ import annotations

import math

import numpy as np

from .. import errors
from ..scene import cameras

FAR = 256.0  # maximum distance of the cameras from the files' origin without a new origin, in spreads
SMALLEST, LARGEST = 1e-25, 1e13  # accepted units between cameras; scenes hold coordinates up to `cameras.FARTHEST`
RESOLUTION = 1e-6  # required float64 resolution at the cameras, as a share of the spread
LONE = 4.0  # assumed spread if all cameras coincide, as in `train.normalization`


def find(
    centers: np.ndarray,  # [C, 3]
    place: str,
) -> np.ndarray:  # [3]
    """Find the point that positions are taken relative to.

    Args:
        centers: Positions of the cameras in the files' world, float64.
        place: Name of the data set, for errors.

    Returns:
        The origin: zero for cameras near the files' origin, else a point among them with few decimal digits. float64

    Raises:
        DatasetError: The cameras are so far away that float64 cannot resolve their positions.
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
            f"{place}: the cameras stand {spread:.3g} units apart but {away:.3g} units from the world's origin: too "
            "far for 64-bit numbers to resolve their positions. Remedy: subtract a constant from all positions in the "
            "program that writes the camera files, before they are rounded"
        )
    digits = -math.floor(math.log10(spread))
    return np.array([round(float(value), digits) for value in middle]) + 0.0  # turns -0.0 into 0.0
