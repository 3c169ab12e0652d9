"""Curves through keys, cubic between two of them: evaluation, slopes, joining.

Between two keys each component is the cubic with the given values and slopes at both ends. In Blender, BEZIER keys with
free handles at a third of the interval give this cubic. Quaternions are interpolated by component and normalised, as
Blender does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import rotations

_ROUNDING = 1e-9  # a key is dropped if this changes the curve by at most this much, relative to its values


@dataclass(frozen=True)
class Keys:
    """Keys of one curve with C components.

    Attributes:
        times: Increasing. [K]
        values: Values at these times. [K, C]
        left_slopes: Incoming slopes per unit of time. [K, C]
        right_slopes: Outgoing slopes; they differ from the incoming ones at a kink. [K, C]
    """

    times: np.ndarray
    values: np.ndarray
    left_slopes: np.ndarray
    right_slopes: np.ndarray


@dataclass(frozen=True)
class Curves:
    """Keys of a rigid motion.

    Attributes:
        location: Displacements of the pivot. [K, 3]
        rotation: Unit wxyz with continuous signs. [K', 4]
        followed: False if keys cannot follow the motion within the tolerance; the curve is then exact only at the keys.
    """

    location: Keys
    rotation: Keys
    followed: bool = True


def evaluate(keys: Keys, times: np.ndarray, *, unit: bool = False) -> np.ndarray:
    """Curve values as Blender evaluates them; constant before the first and after the last key.

    Args:
        keys: The keys.
        times: Any shape. [...]
        unit: Normalise the values, for quaternions.

    Returns:
        [..., C]
    """
    times = np.clip(np.asarray(times, np.float64), keys.times[0], keys.times[-1])
    if len(keys.times) == 1:
        values = np.broadcast_to(keys.values[0], (*times.shape, keys.values.shape[1])).copy()
    else:
        k, h, u = locate(keys.times, times)
        ends, slopes_at_ends = (keys.values[k], keys.values[k + 1]), (keys.right_slopes[k], keys.left_slopes[k + 1])
        values = hermite(*ends, *slopes_at_ends, h[..., None], u[..., None])
    return rotations.normalize(values) if unit else values


def locate(knots: np.ndarray, times: float | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the interval between knots that contains each time.

    Args:
        knots: Increasing, at least two. [K]
        times: Times; those outside the knots belong to the first or last interval. [...]

    Returns:
        Index of the interval's first knot, length of the interval, and fraction of it that has passed. [...] each
    """
    k = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, len(knots) - 2)
    h = knots[k + 1] - knots[k]
    return k, h, (times - knots[k]) / h


def slopes(times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Slopes at knots, from the parabola through each knot and its neighbours, or the nearest three knots at the ends.

    Args:
        times: Increasing. [S]
        values: Values at these times. [..., S, C]

    Returns:
        Slopes per unit of time; the secant for S = 2, zero for S = 1. [..., S, C]
    """
    if len(times) < 2:
        return np.zeros_like(values)
    h = np.diff(times)[:, None]
    secants = np.diff(values, axis=-2) / h
    if len(times) == 2:
        return np.repeat(secants, 2, axis=-2)
    inner = (h[1:] * secants[..., :-1, :] + h[:-1] * secants[..., 1:, :]) / (h[:-1] + h[1:])
    first = 2 * secants[..., :1, :] - inner[..., :1, :]
    last = 2 * secants[..., -1:, :] - inner[..., -1:, :]
    return np.concatenate([first, inner, last], axis=-2)


def hermite(
    left: np.ndarray, right: np.ndarray, left_slope: np.ndarray, right_slope: np.ndarray, h: np.ndarray, u: np.ndarray
) -> np.ndarray:
    """Cubic Hermite interpolation over an interval of length h, at fraction u. All arguments broadcast."""
    u2 = u * u
    u3 = u2 * u
    return (
        (2 * u3 - 3 * u2 + 1) * left
        + (u3 - 2 * u2 + u) * h * left_slope
        + (3 * u2 - 2 * u3) * right
        + (u3 - u2) * h * right_slope
    )


def join(first: Curves, second: Curves) -> Curves:
    """Join the curves of two motions, the second starting where the first ends; a kink between them is kept.

    A curve of one key is constant. It is held until the second motion starts, and remains one key if that motion is
    constant, too. The key at the joint is dropped if it changes nothing, so a straight line at constant speed has two
    keys in total.
    """

    def chain(a: Keys, b: Keys, flip: float) -> Keys:
        if a.times[-1] < b.times[0]:  # a ends with a rest, which is one key
            if len(a.times) == len(b.times) == 1:
                return a
            still = np.zeros_like(a.values[:1])
            a = Keys(
                np.append(a.times, b.times[0]),
                np.concatenate([a.values, a.values[-1:]]),
                np.concatenate([a.left_slopes, still]),
                np.concatenate([a.right_slopes, still]),
            )
        values, left, right = b.values * flip, b.left_slopes * flip, b.right_slopes * flip
        return Keys(
            np.concatenate([a.times, b.times[1:]]),
            np.concatenate([a.values, values[1:]]),
            np.concatenate([a.left_slopes, left[1:]]),
            np.concatenate([a.right_slopes[:-1], right]),
        )

    flip = -1.0 if float(first.rotation.values[-1] @ second.rotation.values[0]) < 0 else 1.0
    joint = float(second.location.times[0])
    location = _without(chain(first.location, second.location, 1.0), joint)
    rotation = _without(chain(first.rotation, second.rotation, flip), joint)
    return Curves(location, rotation, first.followed and second.followed)


def _without(keys: Keys, time: float) -> Keys:
    """Drop the key at a time if the cubic between its neighbours is the same curve up to rounding."""
    k = int(np.searchsorted(keys.times, time))
    if not 0 < k < len(keys.times) - 1 or keys.times[k] != time:
        return keys
    rows = np.delete(np.arange(len(keys.times)), k)
    fewer = Keys(keys.times[rows], keys.values[rows], keys.left_slopes[rows], keys.right_slopes[rows])
    between = np.linspace(keys.times[k - 1], keys.times[k + 1], 17)
    sides = np.abs(keys.left_slopes[k] - keys.right_slopes[k]).max() * (between[-1] - between[0])
    change = max(float(np.abs(evaluate(fewer, between) - evaluate(keys, between)).max()), float(sides))
    return fewer if change <= _ROUNDING * max(float(np.abs(keys.values).max()), 1e-300) else keys
