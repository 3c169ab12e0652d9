"""Fit a motion model to a curve that the user drew after t_max.

`model_selection` identifies a motion law behind noisy observations. This module takes the poses as exact: it tries
kinds from simple to complex and stops at the first within the tolerance; otherwise it returns the best one. A more
complex kind replaces a simpler one only if it reduces the error by more than a tenth. Notation: tau = t - t_max > 0;
radius weights rotations against displacements.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from . import levenberg_marquardt, models, rotations, se3
from .models import MotionModel

# Kinds of `MotionModel` and their free rates, simplest first.
_FITS = sorted(
    ((name, free) for name, kind in models.KINDS.items() for free in kind.drawn_fits), key=lambda fit: len(fit[1])
)


def fit(
    taus: np.ndarray, quats: np.ndarray, displacements: np.ndarray, radius: float, tolerance: float
) -> tuple[MotionModel, float]:
    """Fit motion models to poses.

    Args:
        taus: Times since t_max, > 0, increasing. [S]
        quats: Rotations since t_max, unit wxyz, any sign. [S, 4]
        displacements: Displacements of the pivot since t_max, world units. [S, 3]
        radius: Radius of the group, world units, > 0.
        tolerance: Accepted error, world units.

    Returns:
        The model, and its largest error at a point ``radius`` away from the pivot.
    """
    best = MotionModel(radius=radius)
    error = pose_errors(*models.evaluate(best, taus), quats, displacements, radius).max(initial=0.0)
    for kind, free in _FITS:
        if error <= tolerance:
            break
        model = _solve(kind, free, taus, quats, displacements, radius)
        missed = pose_errors(*models.evaluate(model, taus), quats, displacements, radius).max()
        if missed < 0.9 * error:  # a kind with more parameters must be clearly better
            best, error = model, missed
    return best, float(error)


def pose_errors(
    quats_a: np.ndarray, moves_a: np.ndarray, quats_b: np.ndarray, moves_b: np.ndarray, radius: float
) -> np.ndarray:
    """Upper bound of the distance between the positions that two poses give a point within ``radius`` of the pivot.

    [S, 4], [S, 3] -> [S]
    """
    turn = rotations.angle_between(quats_a, quats_b)
    return np.linalg.norm(moves_a - moves_b, axis=-1) + 2 * radius * np.sin(0.5 * turn)


def _solve(
    kind: str, free: tuple[str, ...], taus: np.ndarray, quats: np.ndarray, displacements: np.ndarray, radius: float
) -> MotionModel:
    """Fit the free rates by least squares, starting from `_rates`."""
    span = float(taus[-1])
    units = {name: (radius if unit.is_length else 1) / span**unit.per_time for name, unit in models.VECTORS.items()}
    first = _rates(taus, quats, displacements)
    start = np.concatenate([first.get(name, np.zeros(3)) / units[name] for name in free])

    def values(x: np.ndarray) -> dict[str, Any]:
        parts = np.split(x, len(free), axis=-1)
        return {name: part * units[name] for name, part in zip(free, parts, strict=True)}

    def errors(batch: np.ndarray) -> np.ndarray:
        found, zero = values(batch[:, None]), np.zeros(3)
        rates = models.Rates(**{models.VECTORS[name].symbol: value for name, value in found.items()})
        poses = models.KINDS[kind].fitted(rates, zero, zero, taus, None)
        return se3.differences(poses, (quats, displacements), radius, 1.0)

    return MotionModel(kind, radius=radius, **values(levenberg_marquardt.solve(errors, start).x))


def _rates(taus: np.ndarray, quats: np.ndarray, displacements: np.ndarray) -> dict[str, np.ndarray]:
    """Rates at t_max of parabolas fitted to the displacements and to the accumulated rotation angles."""
    whole = rotations.make_continuous(np.concatenate([rotations.identity(1), quats]))
    turns = rotations.quats_to_rotvecs(rotations.multiply(whole[1:], rotations.conjugate(whole[:-1])))
    design = np.stack([taus, 0.5 * taus**2], axis=-1)[:, : min(2, len(taus))]
    moves = np.linalg.lstsq(design, displacements, rcond=None)[0]
    angles = np.linalg.lstsq(design, np.cumsum(turns, axis=0), rcond=None)[0]
    names = (("velocity", "acceleration"), ("angular_velocity", "angular_acceleration"))
    found = {}
    for (first, second), values in zip(names, (moves, angles), strict=True):
        found[first] = values[0]
        found[second] = values[1] if len(values) > 1 else np.zeros(3)
    return found
