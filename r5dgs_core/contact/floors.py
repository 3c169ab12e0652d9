"""Height of the ground under a body, from the body's own poses.

The plane of the pictures is about a pixel off. A body that rests, slides or rolls is as high as its ground; at its last
poses, as its height drifts with the errors of its poses. A body that bounces is above its ground in all pictures; its
ground is where the paths before and after the impact meet.
"""

from __future__ import annotations

import numpy as np

from ..motion import rotations
from . import world
from .observed_track import Track
from .world import Body, Plane

_TOUCHED = 0.05  # lowest observed gap, in sizes, of a body that has touched the plane
_ROWS = 3  # poses of a path before or after an impact
_CLEAR = 6.0  # change of the speed in an impact, in units of its noise
_CLOSE = 0.15  # largest height of an impact over the plane, in sizes
_LOWER = 0.05  # depth below it, in sizes, at which a body was never seen
_LAST = 6  # poses of a body that stays on its ground
_STEADY = 0.25  # largest acceleration of their heights, in units of gravity
_FLAT = 0.05  # largest range of their heights, in sizes
_SMOOTH = 3.0  # residual of a path, in units of the noise


def of(body: Body, below: Plane, track: Track, gravity: np.ndarray) -> float | None:
    """Return the height of a moving body's ground along the normal of a plane, or None if its poses do not show it."""
    size, g = body.solid.size, float(np.linalg.norm(gravity))
    gaps = world.gaps(body, below, track.places, track.quats)
    lowest = float(gaps.min(initial=np.inf))
    if lowest < _TOUCHED * size and _stays(gaps, track.times, g, size):
        return below.height + float(np.median(gaps[-_LAST:]))
    impact = _impact(body, below, track, g)
    if impact is not None and impact < _CLOSE * size and impact - _LOWER * size < lowest:
        return below.height + impact
    return below.height + lowest if lowest < _TOUCHED * size else None


def _stays(gaps: np.ndarray, times: np.ndarray, g: float, size: float) -> bool:
    """Return True if the last poses are those of a body that stays on its ground. [S], [S]"""
    gaps, times = gaps[-_LAST:], times[-_LAST:] - times[-1]
    if len(gaps) < _LAST or np.ptp(gaps) > _FLAT * size:
        return False
    return abs(2 * np.polyfit(times, gaps, 2)[0]) < _STEADY * g


def _impact(body: Body, below: Plane, track: Track, g: float) -> float | None:
    """Gap of a body in the strongest impact between two flights, or None if there is none."""
    heights, times, best, found = track.places @ below.normal, track.times, 0.0, None
    for j in range(1, len(track) - 2):
        rows = slice(max(j + 1 - _ROWS, 0), j + 1), slice(j + 1, j + 1 + _ROWS)
        (z0, v0, bad0), (z1, v1, bad1) = (
            _flight(times[row] - times[j], heights[row], track.place_noise[row], g) for row in rows
        )
        noise = float(track.place_noise[rows[0].start : rows[1].stop].max()) / float(
            np.diff(times[j - 1 : j + 3]).min()
        )
        jump = v1 - v0
        if bad0 or bad1 or v0 >= 0 or jump < max(_CLEAR * noise, best):
            continue
        since = (z0 - z1) / jump  # both paths have the same acceleration, so they meet once
        step = times[j + 1] - times[j]
        if not -0.1 * step <= since <= 1.1 * step:
            continue
        turn = rotations.quats_to_rotvecs(
            rotations.multiply(track.quats[j], rotations.conjugate(track.quats[j - 1]))
        ) * (since / (times[j] - times[j - 1]))
        place = track.places[j] + (z0 + v0 * since - 0.5 * g * since**2 - heights[j]) * below.normal
        quat = rotations.multiply(rotations.rotvecs_to_quats(turn), track.quats[j])
        best, found = jump, float(world.gaps(body, below, place, quat))
    return found


def _flight(times: np.ndarray, heights: np.ndarray, noise: np.ndarray, g: float) -> tuple[float, float, bool]:
    """Height and speed at time 0 of a flight, and True if the heights are not those of a flight."""
    columns = np.stack([np.ones_like(times), times], axis=1)
    drop = heights + 0.5 * g * times**2
    (z, v), *_ = np.linalg.lstsq(columns, drop, rcond=None)
    bad = np.abs(columns @ [z, v] - drop) > _SMOOTH * noise
    return float(z), float(v), bool(bad.any())
