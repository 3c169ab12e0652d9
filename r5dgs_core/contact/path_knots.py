"""Few knots that reproduce the recorded path of a body: the model of its motion past t_max.

A bounce that is much shorter than the flights around it becomes one knot with two velocities. Between bounces, knots
are as far apart as the tolerance allows; a galloping search and bisection find them.
"""

from __future__ import annotations

import numpy as np

from ..motion import cubic_curves, knots, rotations
from ..motion.models import MotionModel, trajectory
from .recording import Recording

TOLERANCE = 1e-3  # of the size, for the position of a point
CONTACT_TOLERANCE = 5e-3  # the same from the first contact that is no bounce
_BRIEF = 8.0  # longest bounce that becomes one knot, in units of 1 / w
_FLIGHT = 20.0  # shortest flight before and after it, likewise
_TURN = 2.5  # largest rotation between two knots, rad
_SAMPLES = 48  # per interval that are compared


def model(
    recording: Recording, body: int, center: np.ndarray, pivot: np.ndarray, size: float, fade_time: float
) -> MotionModel:
    """Return the motion of a recorded body about a pivot.

    Args:
        recording: The simulation; it starts at t_max, near the bind state.
        body: Number of the body.
        center: Its centre of mass in the bind state. [3]
        pivot: The pivot in the bind state. [3]
        size: Size of the body.
        fade_time: Time in which the start of the simulation replaces the bind state.
    """
    path = _about_pivot(recording, body, center, pivot)
    rows = _rows(path, recording, body, size)
    quats = rotations.multiply(rows[:, knots.QUAT], rotations.conjugate(rows[0, knots.QUAT]))
    offset, turn = rows[0, knots.PLACE].copy(), rotations.quats_to_rotvecs(rows[0, knots.QUAT])
    rows[:, knots.PLACE] -= offset
    rows[:, knots.QUAT] = rotations.normalize(quats)
    rows[0, knots.QUAT] = rotations.identity()
    if recording.rests:
        rows[-1, 8:] = 0.0
    return MotionModel(
        "trajectory",
        knots=rows,
        offset_rotvec=turn,
        offset_displacement=offset,
        fade_time=fade_time,
        radius=0.5 * size,
        velocity=rows[0, knots.VELOCITY[1]],
        acceleration=np.zeros(3),
        angular_velocity=rows[0, knots.SPIN[1]],
    )


def _about_pivot(recording: Recording, body: int, center: np.ndarray, pivot: np.ndarray) -> np.ndarray:
    """Recorded poses and rates as knots, about a pivot. [N, 20]"""
    quats = rotations.make_continuous(recording.quats[:, body])
    arms = rotations.rotate(quats, np.broadcast_to(pivot - center, (len(quats), 3)))
    spins = recording.spins[:, body]
    velocities = recording.velocities[:, body] + rotations.cross(spins, arms)
    places = recording.places[:, body] + arms - pivot
    return knots.pack(recording.times, (quats, places), (velocities, velocities), (spins, spins))


def _rows(path: np.ndarray, recording: Recording, body: int, size: float) -> np.ndarray:
    """Chosen knots of a path. [N, 20] -> [K, 20]"""
    touching, start, found = recording.touching[:, body].copy(), 0, []
    pieces = _bounces(path[:, knots.TIME], touching, recording.frequency)
    for first, last in pieces:
        touching[first:last] = False
    rattling = np.logical_or.accumulate(touching)
    lead = path[0].copy()
    for first, last in [*pieces, (len(path) - 1, len(path) - 1)]:
        for row in _walk(path, rattling, start, first, size):
            found.append(lead)
            lead = path[row].copy()
        if last > first:
            lead = _corner(path[first], path[last])
        start = last
    return np.array([*found, lead])


def _bounces(times: np.ndarray, touching: np.ndarray, frequency: float) -> list[tuple[int, int]]:
    """Last row before and first row after each brief contact that is between two flights."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], touching, [False]]).astype(int))).reshape(-1, 2)
    ends = np.concatenate([[0], edges.ravel(), [len(times) - 1]]).clip(0, len(times) - 1)
    lengths = frequency * np.diff(times[ends])  # flights and contacts in turn
    brief = (lengths[1::2] < _BRIEF) & (lengths[:-1:2] > _FLIGHT) & (lengths[2::2] > _FLIGHT)
    return [(int(on) - 1, int(off)) for on, off in edges[brief]]


def _corner(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Knot that replaces a bounce: its position is where the flights before and after it come nearest. [20]"""
    span = after[knots.TIME] - before[knots.TIME]
    change = after[knots.VELOCITY[0]] - before[knots.VELOCITY[0]]
    apart = after[knots.PLACE] - after[knots.VELOCITY[0]] * span - before[knots.PLACE]
    wait = float(np.clip(-(apart @ change) / max(change @ change, 1e-300), 0.0, span))
    row = before.copy()
    row[knots.TIME] += wait
    ends = (
        before[knots.PLACE] + wait * before[knots.VELOCITY[0]],
        after[knots.PLACE] - (span - wait) * after[knots.VELOCITY[0]],
    )
    row[knots.PLACE] = 0.5 * (ends[0] + ends[1])
    row[knots.QUAT] = rotations.interpolate(before[knots.QUAT], after[knots.QUAT], wait / max(span, 1e-300))
    for part in (knots.VELOCITY, knots.SPIN):
        row[part[0]], row[part[1]] = before[part[0]], after[part[0]]
    return row


def _walk(path: np.ndarray, rattling: np.ndarray, start: int, stop: int, size: float) -> list[int]:
    """Rows of the greedy knots after ``start``, the last is ``stop``."""
    found = []
    while start < stop:
        reach, step, grows = start + 1, 1, True
        while step and reach < stop:
            end = min(reach + step, stop)
            if _follows(path, rattling, start, end, size):
                reach, step = end, 2 * step if grows else step // 2
            else:
                step, grows = step // 2, False
        found.append(reach)
        start = reach
    return found


def _follows(path: np.ndarray, rattling: np.ndarray, start: int, stop: int, size: float) -> bool:
    """Return True if one interval between two rows reproduces the path."""
    rows = np.unique(np.linspace(start, stop, _SAMPLES).astype(int))
    a, b, h = path[start], path[stop], path[stop, knots.TIME] - path[start, knots.TIME]
    limit = (CONTACT_TOLERANCE if rattling[stop - 1] else TOLERANCE) * size
    u = ((path[rows, knots.TIME] - a[knots.TIME]) / h)[:, None]
    ends = (a[knots.PLACE], b[knots.PLACE], a[knots.VELOCITY[1]], b[knots.VELOCITY[0]])
    missed = np.linalg.norm(cubic_curves.hermite(*ends, h, u) - path[rows, knots.PLACE], axis=1)
    if missed.max() > limit:
        return False
    turns = rotations.quats_to_rotvecs(rotations.multiply(path[rows, knots.QUAT], rotations.conjugate(a[knots.QUAT])))
    if np.linalg.norm(turns, axis=1).max() > _TURN:
        return False
    shown = trajectory.between(a, b, path[rows, knots.TIME])[0]
    return bool((missed + 0.5 * size * rotations.angle_between(shown, path[rows, knots.QUAT])).max() <= limit)
