"""Checks of motion models: rates that playback can use."""

from __future__ import annotations

import numpy as np

from .. import findings
from ..motion import knots, models
from . import cameras
from .array_shapes import fail

SPIN = 1e6  # maximum rad per unit of time, and per its square
MAX_TIME = 1e12  # maximum time
MIN_LENGTH = 1e-30  # minimum radius
MIN_STEP = 1e-12  # minimum time


def _limit(unit: models.Unit) -> float:
    """Largest number of a rate."""
    if unit.per_time < 0:
        return MAX_TIME
    return cameras.FARTHEST if unit.is_length else SPIN


_LIMITS = {name: _limit(unit) for name, unit in {**models.VECTORS, **models.SCALARS}.items()}
_COLUMNS = {
    "knot times": (knots.TIME, MAX_TIME),
    "knot places": (knots.PLACE, cameras.FARTHEST),
    "velocities before knots": (knots.VELOCITY[0], cameras.FARTHEST),
    "velocities after knots": (knots.VELOCITY[1], cameras.FARTHEST),
    "spins before knots": (knots.SPIN[0], SPIN),
    "spins after knots": (knots.SPIN[1], SPIN),
}
_LIMITS |= {"fade_time": MAX_TIME, "radius": cameras.FARTHEST}


def check(model: models.MotionModel, place: str, guard: findings.Guard) -> None:
    """Raise `SceneFileError` naming a rate that playback cannot use."""
    for name, limit in _LIMITS.items():
        with guard():
            value = np.max(np.abs(getattr(model, name)))
            if not value <= limit:
                fail(place, name, f"numbers up to {limit:g}", f"{value:g}")
    if model.knots is not None:
        _check_knots(model.knots, place, guard)
    with guard():
        if model.radius < MIN_LENGTH or model.fade_time < MIN_STEP:
            fail(place, "radius and fade_time", f"{MIN_LENGTH:g} and {MIN_STEP:g} or more", "less")


def _check_knots(rows: np.ndarray, place: str, guard: findings.Guard) -> None:
    for name, (part, limit) in _COLUMNS.items():
        with guard():
            value = np.abs(rows[:, part]).max()
            if not value <= limit:
                fail(place, name, f"numbers up to {limit:g}", f"{value:g}")
    with guard():
        if (np.diff(rows[:, knots.TIME]) < MIN_STEP).any():
            fail(place, "knots", f"times that increase by {MIN_STEP:g} or more", "less")
