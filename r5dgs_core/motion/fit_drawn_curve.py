"""Fit a motion model to a curve that the user drew after t_max.

`model_selection` identifies a motion law behind noisy observations. This module takes the poses as exact: it returns
the simplest kind within a tolerance, else the kind with the smallest error. Notation: tau = t - t_max > 0; radius
weights rotations against displacements.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from . import models, rotations
from .models import MotionModel

# Kinds of `MotionModel` and their free rates, simplest first.
_FITS = sorted(
    ((name, free) for name, kind in models.KINDS.items() for free in kind.drawn_fits), key=lambda fit: len(fit[1])
)
_STEPS = 60
_DIFFERENCE = 1e-6


def fit(
    taus: np.ndarray, quats: np.ndarray, displacements: np.ndarray, radius: float, tolerance: float
) -> tuple[MotionModel, float]:
    """Fit motion models to poses.

    Args:
        taus: Times since t_max, > 0, increasing. [S]
        quats: Rotations since t_max, unit wxyz, any sign. [S, 4]
        displacements: Of the pivot since t_max, world units. [S, 3]
        radius: Of the group, world units, > 0.
        tolerance: Error that is good enough, world units.

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
    """Upper bound of the distance between two poses of a point within ``radius`` of the pivot. [S, 4], [S, 3] -> [S]"""
    turn = rotations.angle_between(quats_a, quats_b)
    return np.linalg.norm(moves_a - moves_b, axis=-1) + 2 * radius * np.sin(0.5 * turn)


def _solve(
    kind: str, free: tuple[str, ...], taus: np.ndarray, quats: np.ndarray, displacements: np.ndarray, radius: float
) -> MotionModel:
    """Fit the free rates by Levenberg-Marquardt, starting from `_rates`."""
    span = float(taus[-1])
    rate = {"velocity": radius / span, "acceleration": radius / span**2, "center_offset": radius}
    rate |= {"angular_velocity": 1 / span, "angular_acceleration": 1 / span**2}
    units = np.repeat([rate[name] for name in free], 3)
    first = _rates(taus, quats, displacements)

    def model_of(x: np.ndarray) -> MotionModel:
        values: dict[str, Any] = dict(zip(free, np.split(x * units, len(free)), strict=True))
        return MotionModel(kind, radius=radius, **values)

    def errors(x: np.ndarray) -> np.ndarray:
        q, d = models.evaluate(model_of(x), taus)
        turns = rotations.quats_to_rotvecs(rotations.multiply(q, rotations.conjugate(quats)))
        return np.concatenate([(d - displacements) / radius, turns], axis=-1).ravel()

    x = np.concatenate([first.get(name, np.zeros(3)) for name in free]) / units
    damping, now = 1e-4, errors(x)
    for _ in range(_STEPS):
        size = _DIFFERENCE * max(1.0, float(np.abs(x).max()))
        jacobian = np.stack([errors(x + size * axis) - now for axis in np.eye(len(x))], axis=-1) / size
        step = -np.linalg.solve(jacobian.T @ jacobian + damping * np.eye(len(x)), jacobian.T @ now)
        then = errors(x + step)
        if (then**2).sum() < (now**2).sum():
            x, now, damping = x + step, then, max(damping / 10, 1e-12)
            if np.abs(step).max() < 1e-9 * max(1.0, float(np.abs(x).max())):
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return model_of(x)


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
