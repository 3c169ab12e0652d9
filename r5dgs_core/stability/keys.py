"""Stability cases on keys for Blender, including their float32 evaluation in Blender."""

from __future__ import annotations

import functools
import math

import numpy as np

from ..motion import cubic_curves, key_reduction, rotations
from .cases import RADIUS, Case, body, largest, model_of, moved
from .scenes import MOTIONS, T_MAX

_KEYED = 1.0  # units past t_max that get keys
_SHARE = 1e-3  # of the body's size: tolerance of keys


def _reduced(name: str) -> tuple[cubic_curves.Curves, key_reduction.Sampler]:
    sample = key_reduction.model_sampler(MOTIONS[name], T_MAX)
    return key_reduction.reduce(sample, T_MAX, T_MAX + _KEYED, _SHARE * 2 * RADIUS, RADIUS), sample


def _keys(name: str) -> float:
    """Error of keys on a grid of 960 samples per unit, relative to their tolerance."""
    curves, sample = _reduced(name)
    times = np.linspace(T_MAX, T_MAX + _KEYED, 961)
    quats, displacements, _, _ = sample(times)
    found = cubic_curves.evaluate(curves.rotation, times, unit=True), cubic_curves.evaluate(curves.location, times)
    return _key_error(found, (quats, displacements)) / (_SHARE * 2 * RADIUS)


def _blender_keys(name: str) -> float:
    """Error of keys as in `_keys`, evaluated like Blender: keys and handles in float32, counted in frames."""
    curves, sample = _reduced(name)
    frames = np.arange(60 * T_MAX, 60 * (T_MAX + _KEYED), 0.25)
    quats, displacements, _, _ = sample(frames / 60)
    found = blender_values(curves.rotation, frames), blender_values(curves.location, frames)
    turned = rotations.normalize(found[0].astype(np.float64))
    return _key_error((turned, found[1]), (quats, displacements)) / (_SHARE * 2 * RADIUS)


def _key_error(found: tuple[np.ndarray, np.ndarray], true: tuple[np.ndarray, np.ndarray]) -> float:
    places = [moved((q[:, None], d[:, None]), body()[None]) for q, d in (found, true)]
    return largest(places[0] - places[1])


def _key_steps() -> float:
    """Largest rotation between neighbouring keys of a body that turns by 10 rad, relative to 120 degrees."""
    model = model_of("ballistic_spin", angular_velocity=[0, 6, 8])
    sample = key_reduction.model_sampler(model, T_MAX)
    keys = key_reduction.reduce(sample, T_MAX, T_MAX + _KEYED, 0.5, RADIUS).rotation
    turns = rotations.angle_between(keys.values[1:], keys.values[:-1])
    return float(turns.max() / math.radians(120))


def _static_keys() -> float:
    """Number of keys in excess of one per curve, for a body at rest."""
    curves, _ = _reduced("static")
    return float(len(curves.location.times) + len(curves.rotation.times) - 2)


def blender_values(keys: cubic_curves.Keys, frames: np.ndarray, frames_per_unit: float = 60.0) -> np.ndarray:
    """Evaluate a curve like Blender's Bezier keys with free handles: float32 control points, a cubic solved for time.

    Args:
        keys: The keys; their handles lie at a third of the interval.
        frames: Frames, with fractions. [F]
        frames_per_unit: Frames per unit of time.

    Returns:
        Values, not normalised. [F, C] float32
    """
    x = (keys.times * frames_per_unit).astype(np.float32)
    y = keys.values.astype(np.float32)
    if len(x) == 1:
        return np.repeat(y, len(frames), axis=0)
    frames = np.clip(frames, x[0], x[-1]).astype(np.float32)
    k = np.clip(np.searchsorted(x, frames, side="right") - 1, 0, len(x) - 2)
    third = (np.diff(keys.times) / 3)[k]
    xs = [x[k], (x[k] + third * frames_per_unit).astype(np.float32), (x[k + 1] - third * frames_per_unit), x[k + 1]]
    ys = [y[k], y[k] + third[:, None] * keys.right_slopes[k], y[k + 1] - third[:, None] * keys.left_slopes[k + 1]]
    xs, ys = [part.astype(np.float32) for part in xs], [part.astype(np.float32) for part in (*ys, y[k + 1])]
    low, high = np.zeros(len(frames)), np.ones(len(frames))
    for _ in range(60):
        middle = 0.5 * (low + high)
        early = _bezier([part.astype(np.float64) for part in xs], middle) < frames
        low, high = np.where(early, middle, low), np.where(early, high, middle)
    return _bezier(ys, (0.5 * (low + high)).astype(np.float32)[:, None])


def _bezier(points: list[np.ndarray], u: np.ndarray) -> np.ndarray:
    """Cubic with four control points at a fraction, in powers of the fraction as Blender sums them."""
    c1 = 3 * (points[1] - points[0])
    c2 = 3 * (points[0] - 2 * points[1] + points[2])
    c3 = points[3] - points[0] + 3 * (points[1] - points[2])
    return points[0] + u * (c1 + u * (c2 + u * c3))


_TOLERANCE = "error / tolerance of 0.1 % of the size"

CASES: tuple[Case, ...] = (
    *(
        Case(
            "keys",
            f"{name}: on a grid four times finer",
            "motion.key_reduction.reduce",
            _TOLERANCE,
            1.0,
            "requested tolerance",
            functools.partial(_keys, name),
        )
        for name in MOTIONS
    ),
    *(
        Case(
            "keys",
            f"{name}: as Blender evaluates them",
            "motion.key_reduction.reduce",
            _TOLERANCE,
            1.0,
            "requested tolerance, in float32",
            functools.partial(_blender_keys, name),
        )
        for name in MOTIONS
    ),
    Case(
        "keys",
        "no step over 120 degrees",
        "motion.key_reduction.reduce",
        "largest step / 120 degrees",
        1.0,
        "signs of quaternions",
        _key_steps,
    ),
    Case(
        "keys",
        "a body at rest has one key per curve",
        "motion.key_reduction.reduce",
        "keys too many",
        0.0,
        "count",
        _static_keys,
    ),
)
