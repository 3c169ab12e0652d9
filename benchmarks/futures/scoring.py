"""Errors of predicted poses, failures and flags, as all benchmarks of futures count them."""

from __future__ import annotations

import numpy as np

from r5dgs_core.motion.history import Band

BAD = 20.0  # error of a failure, % of the size


def surface_error(distances: np.ndarray, angles: np.ndarray | float, size: float) -> np.ndarray:
    """Return the root mean square error over the surface of a ball, in % of its size.

    Args:
        distances: Position errors. [H]
        angles: Rotation errors, rad. [H] or one for all
        size: Diameter of the ball, in the unit of the positions.
    """
    turned = size * np.sin(0.5 * np.asarray(angles))
    return 100 / size * np.sqrt(distances**2 + 2 / 3 * turned**2)


def half_widths(band: Band, times: np.ndarray, size: float) -> np.ndarray:
    """Return the half widths of a band, in % of the body's size. [H]"""
    return 100 / size * band.widths(times)


def flagged(band: Band, end: float) -> bool:
    """Return True if the motion is reported as not predictable up to a time."""
    return band.predictable_until is not None and bool(band.predictable_until < end)
