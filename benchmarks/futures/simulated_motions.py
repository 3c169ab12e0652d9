"""Simulated motions of a body that are smooth, or bounce several times. Independent of the fit.

A motion is a function from times in [0, 1] to places [S, 3] and rotations of the body. Each takes its parameters from
ranges. The body is a box whose circumscribed ball has the radius `RADIUS`; it is observed until `T_MAX`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

RADIUS = 0.25
T_MAX = 0.75
POSES = 15
UP = np.array([0.0, 0.0, 1.0])
SIDES = np.array([0.4, 0.26, 0.14])  # of the box

Poses = tuple[np.ndarray, Rotation]
Path = Callable[[np.ndarray], Poses]


@dataclass(frozen=True)
class Motion:
    """A motion with the times of its events.

    Attributes:
        path: Poses at times [S].
        events: Times at which the velocity or the kind of motion changes, in [0, 1].
        jump: Largest velocity jump at the events, including RADIUS times that of the spin; 0 if only the kind of motion
            changes.
        slip: Rotation vector, in the body's frame, by which the last observed rotations are wrong.
        slipped: Number of these poses.
    """

    path: Path
    events: tuple[float, ...] = ()
    jump: float = 0.0
    slip: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    slipped: int = 0


Maker = Callable[[np.random.Generator], Motion]


def box_inertia() -> np.ndarray:
    """Inertia of the box, up to a factor. [3, 3]"""
    squares = SIDES**2
    return np.diag(squares.sum() - squares)


def turned(vectors: np.ndarray) -> Rotation:
    return Rotation.from_rotvec(vectors)


def direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def _linear(v: np.ndarray, w: np.ndarray, clock: Callable[[np.ndarray], np.ndarray], g: float = 0.0) -> Path:
    """Position and rotation vector proportional to a clock, plus a fall with acceleration g."""

    def path(t: np.ndarray) -> Poses:
        s = clock(t)[:, None]
        return v * s - 0.5 * g * t[:, None] ** 2 * UP, turned(w * s)

    return path


def _same(t: np.ndarray) -> np.ndarray:
    return t


def static(rng: np.random.Generator) -> Motion:
    """A body at rest."""
    return Motion(_linear(np.zeros(3), np.zeros(3), _same))


def slow(rng: np.random.Generator) -> Motion:
    """A slow steady motion."""
    return Motion(_linear(0.05 * rng.normal(size=3), 0.2 * rng.normal(size=3), _same))


def steady(rng: np.random.Generator) -> Motion:
    """Constant velocity and spin."""
    return Motion(_linear(0.8 * rng.normal(size=3), 1.5 * rng.normal(size=3), _same))


def ballistic(rng: np.random.Generator) -> Motion:
    """Free flight with constant spin."""
    v = 0.8 * rng.normal(size=3)
    v[2] = rng.uniform(1.0, 2.5)
    return Motion(_linear(v, 1.8 * rng.normal(size=3), _same, rng.uniform(2.5, 6.0)))


def hinge(rng: np.random.Generator) -> Motion:
    """Rotation about a fixed axis with constant angular acceleration."""
    axis, arm = direction(rng), 0.4 * direction(rng)
    w, eps = rng.uniform(0.8, 2.0), rng.uniform(-0.5, 0.5)

    def path(t: np.ndarray) -> Poses:
        turn = turned((w * t + 0.5 * eps * t**2)[:, None] * axis)
        return turn.apply(arm), turn

    return Motion(path)


def pendulum(rng: np.random.Generator) -> Motion:
    """A physical pendulum with large swings."""
    length, start, g = rng.uniform(0.4, 0.8), rng.uniform(0.3, 1.2), rng.uniform(10.0, 30.0)
    axis = np.array([math.cos(a := rng.uniform(0, math.tau)), math.sin(a), 0.0])
    solved = solve_ivp(
        lambda _, s: [s[1], -g / length * math.sin(s[0])], (0, 1), [start, 0], dense_output=True, rtol=1e-9
    ).sol

    def path(t: np.ndarray) -> Poses:
        turn = turned(solved(t)[0][:, None] * axis)
        return turn.apply(-length * UP), turn

    return Motion(path)


def circle(rng: np.random.Generator) -> Motion:
    """Steady motion on a circle, turning with it."""
    radius, w, axis = rng.uniform(0.5, 1.0), rng.uniform(1.5, 4.0), direction(rng)
    arm = radius * np.cross(axis, direction(rng))

    def path(t: np.ndarray) -> Poses:
        turn = turned(w * t[:, None] * axis)
        return turn.apply(arm), turn

    return Motion(path)


def tumbling(rng: np.random.Generator) -> Motion:
    """Free flight of a box that spins about its middle axis, without torque."""
    moments = np.diag(box_inertia())

    def rates(_: float, s: np.ndarray) -> np.ndarray:
        q, w = s[:4], s[4:]
        spin = np.cross(moments * w, w) / moments
        return np.concatenate([[-0.5 * q[1:] @ w], 0.5 * (q[0] * w + np.cross(q[1:], w)), spin])

    first = [1, 0, 0, 0, 0.3 * rng.normal(), rng.uniform(5, 8), 0.3 * rng.normal()]
    solved = solve_ivp(rates, (0, 1), first, dense_output=True, rtol=1e-9, atol=1e-10).sol
    v, g = 0.4 * rng.normal(size=3) + 2 * UP, rng.uniform(3, 5)

    def path(t: np.ndarray) -> Poses:
        q = solved(t).T[:, :4]
        return v * t[:, None] - 0.5 * g * t[:, None] ** 2 * UP, Rotation.from_quat(np.roll(q, -1, axis=1))

    return Motion(path)


def gyroscope(rng: np.random.Generator) -> Motion:
    """Steady precession of a spinning body about a pivot."""
    turn, spin, tilt = rng.uniform(2, 5), rng.uniform(4, 9), rng.uniform(0.3, 0.8)
    arm = rng.uniform(0.2, 0.5) * UP

    def path(t: np.ndarray) -> Poses:
        pose = turned(turn * t[:, None] * UP) * turned(np.array([0, tilt, 0])) * turned(spin * t[:, None] * UP)
        return pose.apply(arm), pose

    return Motion(path)


def _until(stop: float, v: np.ndarray, w: np.ndarray) -> Motion:
    def clock(t: np.ndarray) -> np.ndarray:
        u = np.minimum(t, stop)
        return u - u**2 / (2 * stop)

    return Motion(_linear(v, w, clock), (stop,) if stop < T_MAX else ())


def rolls_until(low: float, high: float) -> Maker:
    """A ball that rolls with constant friction and rests after a time between two limits."""

    def make(rng: np.random.Generator) -> Motion:
        speed, a = rng.uniform(1.0, 2.0), rng.uniform(0, math.tau)
        v = speed * np.array([math.cos(a), math.sin(a), 0])
        return _until(rng.uniform(low, high), v, np.cross(UP, v) / RADIUS)

    return make


def slides_until(low: float, high: float) -> Maker:
    """A block that slides with constant friction."""

    def make(rng: np.random.Generator) -> Motion:
        v = rng.uniform(1.0, 2.0) * np.array([math.cos(a := rng.uniform(0, math.tau)), math.sin(a), 0])
        return _until(rng.uniform(low, high), v, np.zeros(3))

    return make


def drag(rng: np.random.Generator) -> Motion:
    """Velocity and spin that decay exponentially."""
    c = rng.uniform(2, 6)
    return Motion(_linear(2.5 * rng.normal(size=3), 4 * rng.normal(size=3), lambda t: -np.expm1(-c * t) / c))


def falls_with_drag(rng: np.random.Generator) -> Motion:
    """A fall that approaches its terminal velocity."""
    c, v, w, g = rng.uniform(2, 6), 1.5 * rng.normal(size=3), 2 * rng.normal(size=3), rng.uniform(6, 10)

    def path(t: np.ndarray) -> Poses:
        s = (-np.expm1(-c * t) / c)[:, None]
        return v * s - g / c * UP * (t[:, None] - s), turned(w * s)

    return Motion(path)


def damped_spring(rng: np.random.Generator) -> Motion:
    """A body on a damped spring."""
    frequency, c = rng.uniform(8, 16), rng.uniform(1, 4)
    way = rng.uniform(0.2, 0.6) * direction(rng)
    phase = rng.uniform(0, math.tau)

    def path(t: np.ndarray) -> Poses:
        return way * (np.exp(-c * t) * np.cos(frequency * t + phase))[:, None], turned(np.zeros((len(t), 3)))

    return Motion(path)


def damped_pendulum(rng: np.random.Generator) -> Motion:
    """A hinged body whose swings decay."""
    frequency, c, size = rng.uniform(8, 14), rng.uniform(0.8, 3), rng.uniform(0.3, 0.8)
    axis, phase = direction(rng), rng.uniform(0, math.tau)
    arm = rng.uniform(0.3, 0.6) * np.cross(axis, direction(rng))

    def path(t: np.ndarray) -> Poses:
        turn = turned((size * np.exp(-c * t) * np.cos(frequency * t + phase))[:, None] * axis)
        return turn.apply(arm), turn

    return Motion(path)


def lissajous(rng: np.random.Generator) -> Motion:
    """The sum of two oscillations, each seen for a full period or more; it rocks with the first."""
    slower = rng.uniform(math.tau / T_MAX, 13)
    frequencies = np.array([slower, slower * rng.uniform(1.3, 2.0)])
    ways = rng.uniform(0.2, 0.5, 2)[:, None] * np.stack([direction(rng), direction(rng)])
    phases, rock = rng.uniform(0, math.tau, 2), 0.3 * direction(rng)

    def path(t: np.ndarray) -> Poses:
        waves = np.sin(frequencies * t[:, None] + phases)
        return waves @ ways, turned(waves[:, :1] * rock)

    return Motion(path)


def slow_lissajous(rng: np.random.Generator) -> Motion:
    """Three oscillations, of which less than a period is seen."""
    ways, frequencies, phases = (rng.uniform(*limits, 3) for limits in ((0.2, 0.5), (3, 9), (0, math.tau)))

    def path(t: np.ndarray) -> Poses:
        angle = frequencies * t[:, None]
        return ways * np.sin(angle + phases), turned(0.4 * np.sin(angle))

    return Motion(path)


def double_pendulum(rng: np.random.Generator) -> Motion:
    """The lower link of a double pendulum."""
    length, g = 0.5, rng.uniform(10, 18)

    def rates(_: float, s: np.ndarray) -> list[float]:
        a, b, p, q = s
        c = math.cos(a - b)
        scale = 6 / length**2 / (16 - 9 * c**2)
        da, db = scale * (2 * p - 3 * c * q), scale * (8 * q - 3 * c * p)
        pull = da * db * math.sin(a - b)
        half = -0.5 * length**2
        return [da, db, half * (pull + 3 * g / length * math.sin(a)), half * (-pull + g / length * math.sin(b))]

    first = [rng.uniform(0.5, 1.3), rng.uniform(-0.5, 1), 0, 0]
    solved = solve_ivp(rates, (0, 1), first, dense_output=True, rtol=1e-9).sol

    def path(t: np.ndarray) -> Poses:
        a, b = solved(t)[:2]
        ends = [np.stack([np.sin(x), 0 * x, -np.cos(x)], -1) * length for x in (a, b)]
        return ends[0] + 0.5 * ends[1], turned(-b[:, None] * np.array([0, 1.0, 0]))

    return Motion(path)


def bounces(rng: np.random.Generator) -> Motion:
    """A ball that bounces several times and loses speed each time."""
    g, keep, first = rng.uniform(15, 25), rng.uniform(0.7, 0.9), rng.uniform(0.1, 0.3)
    speed = g * rng.uniform(0.25, 0.4) / 2
    across, w = np.array([*(0.6 * rng.normal(size=2)), 0.0]), 1.5 * rng.normal(size=3)
    hits, speeds = [first], [speed]
    while hits[-1] < 1.5 and len(hits) < 60:
        hits.append(hits[-1] + 2 * speeds[-1] / g)
        speeds.append(keep * speeds[-1])

    def path(t: np.ndarray) -> Poses:
        k = np.searchsorted(hits, t, side="right") - 1
        since = t - np.array(hits)[np.maximum(k, 0)]
        up = np.where(k < 0, speed / keep, np.array(speeds)[np.maximum(k, 0)])
        since = np.where(k < 0, t - first + 2 * up / g, since)
        high = np.where(k == len(hits) - 1, 0.0, up * since - 0.5 * g * since**2)
        return across * t[:, None] + high[:, None] * UP, turned(w * t[:, None])

    seen = tuple(hit for hit in hits if hit < T_MAX)
    return Motion(path, seen, speed * (1 + 1 / keep))


def bounces_on_rough_floor(rng: np.random.Generator) -> Motion:
    """The same, and each impact until `T_MAX` changes its spin."""
    smooth = bounces(rng)
    starts, stops = (0.0, *smooth.events), (*smooth.events, np.inf)
    spins = 1.5 * rng.normal(size=(len(starts), 3))

    def path(t: np.ndarray) -> Poses:
        turns = turned(np.zeros((len(t), 3)))
        for start, stop, w in zip(starts, stops, spins, strict=True):
            turns = turned(w * (np.clip(t, start, stop) - start)[:, None]) * turns
        return smooth.path(t)[0], turns

    return dataclasses.replace(smooth, path=path)


def grid(poses: int = POSES) -> np.ndarray:
    """Observed times, evenly spaced with the last at `T_MAX`."""
    return np.linspace(0.0, T_MAX, poses)
