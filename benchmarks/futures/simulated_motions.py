"""Simulated motions of a body with known truth, and noisy observations of them. Independent of the fit.

A motion is a function from times in [0, 1] to places [S, 3] and rotations of the body. Each draw takes its parameters
from ranges. The body is a box whose circumscribed ball has the radius `RADIUS`; it is observed until `T_MAX`.
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


def _turned(vectors: np.ndarray) -> Rotation:
    return Rotation.from_rotvec(vectors)


def _direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def _linear(v: np.ndarray, w: np.ndarray, clock: Callable[[np.ndarray], np.ndarray], g: float = 0.0) -> Path:
    """Position and rotation vector proportional to a clock, plus a fall with acceleration g."""

    def path(t: np.ndarray) -> Poses:
        s = clock(t)[:, None]
        return v * s - 0.5 * g * t[:, None] ** 2 * UP, _turned(w * s)

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
    axis, arm = _direction(rng), 0.4 * _direction(rng)
    w, eps = rng.uniform(0.8, 2.0), rng.uniform(-0.5, 0.5)

    def path(t: np.ndarray) -> Poses:
        turn = _turned((w * t + 0.5 * eps * t**2)[:, None] * axis)
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
        turn = _turned(solved(t)[0][:, None] * axis)
        return turn.apply(-length * UP), turn

    return Motion(path)


def circle(rng: np.random.Generator) -> Motion:
    """Steady motion on a circle, turning with it."""
    radius, w, axis = rng.uniform(0.5, 1.0), rng.uniform(1.5, 4.0), _direction(rng)
    arm = radius * np.cross(axis, _direction(rng))

    def path(t: np.ndarray) -> Poses:
        turn = _turned(w * t[:, None] * axis)
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
        pose = _turned(turn * t[:, None] * UP) * _turned(np.array([0, tilt, 0])) * _turned(spin * t[:, None] * UP)
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
        return v * s - g / c * UP * (t[:, None] - s), _turned(w * s)

    return Motion(path)


def damped_spring(rng: np.random.Generator) -> Motion:
    """A body on a damped spring."""
    frequency, c = rng.uniform(8, 16), rng.uniform(1, 4)
    way = rng.uniform(0.2, 0.6) * _direction(rng)
    phase = rng.uniform(0, math.tau)

    def path(t: np.ndarray) -> Poses:
        return way * (np.exp(-c * t) * np.cos(frequency * t + phase))[:, None], _turned(np.zeros((len(t), 3)))

    return Motion(path)


def damped_pendulum(rng: np.random.Generator) -> Motion:
    """A hinged body whose swings decay."""
    frequency, c, size = rng.uniform(8, 14), rng.uniform(0.8, 3), rng.uniform(0.3, 0.8)
    axis, phase = _direction(rng), rng.uniform(0, math.tau)
    arm = rng.uniform(0.3, 0.6) * np.cross(axis, _direction(rng))

    def path(t: np.ndarray) -> Poses:
        turn = _turned((size * np.exp(-c * t) * np.cos(frequency * t + phase))[:, None] * axis)
        return turn.apply(arm), turn

    return Motion(path)


def lissajous(rng: np.random.Generator) -> Motion:
    """The sum of two oscillations, each seen for a full period or more; it rocks with the first."""
    slower = rng.uniform(math.tau / T_MAX, 13)
    frequencies = np.array([slower, slower * rng.uniform(1.3, 2.0)])
    ways = rng.uniform(0.2, 0.5, 2)[:, None] * np.stack([_direction(rng), _direction(rng)])
    phases, rock = rng.uniform(0, math.tau, 2), 0.3 * _direction(rng)

    def path(t: np.ndarray) -> Poses:
        waves = np.sin(frequencies * t[:, None] + phases)
        return waves @ ways, _turned(waves[:, :1] * rock)

    return Motion(path)


def slow_lissajous(rng: np.random.Generator) -> Motion:
    """Three oscillations, of which less than a period is seen."""
    ways, frequencies, phases = (rng.uniform(*limits, 3) for limits in ((0.2, 0.5), (3, 9), (0, math.tau)))

    def path(t: np.ndarray) -> Poses:
        angle = frequencies * t[:, None]
        return ways * np.sin(angle + phases), _turned(0.4 * np.sin(angle))

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
        return ends[0] + 0.5 * ends[1], _turned(-b[:, None] * np.array([0, 1.0, 0]))

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
        return across * t[:, None] + high[:, None] * UP, _turned(w * t[:, None])

    seen = tuple(hit for hit in hits if hit < T_MAX)
    return Motion(path, seen, speed * (1 + 1 / keep))


EventMaker = Callable[[np.random.Generator, float], Motion]


def _jump(at: float, v: tuple[np.ndarray, np.ndarray], w: tuple[np.ndarray, np.ndarray], g: float = 0.0) -> Motion:
    def path(t: np.ndarray) -> Poses:
        before, after = np.minimum(t - at, 0)[:, None], np.maximum(t - at, 0)[:, None]
        fall = 0.5 * g * (t[:, None] - at) ** 2 * UP
        return v[0] * before + v[1] * after - fall, _turned(w[1] * after) * _turned(w[0] * before)

    size = math.hypot(np.linalg.norm(v[1] - v[0]), RADIUS * np.linalg.norm(w[1] - w[0]))
    return Motion(path, (at,), float(size))


def collides(rng: np.random.Generator, at: float) -> Motion:
    """Velocity and spin change at once."""
    v, w = rng.normal(size=(2, 3)), 1.5 * rng.normal(size=(2, 3))
    return _jump(at, (v[0], v[1]), (w[0], w[1]))


def starts(rng: np.random.Generator, at: float) -> Motion:
    """A body at rest that starts to move at once."""
    return _jump(at, (np.zeros(3), 1.2 * rng.normal(size=3)), (np.zeros(3), 2 * rng.normal(size=3)))


def stops(rng: np.random.Generator, at: float) -> Motion:
    """A moving body that stops at once."""
    return _jump(at, (1.2 * rng.normal(size=3), np.zeros(3)), (2 * rng.normal(size=3), np.zeros(3)))


def bounces_once(rng: np.random.Generator, at: float) -> Motion:
    """A flight with one bounce that changes the spin; the next one comes after t = 1."""
    g, keep, speed = 12.0, rng.uniform(0.6, 0.9), rng.uniform(4.2, 5.5)
    across, w = np.array([*(0.6 * rng.normal(size=2)), 0.0]), 1.5 * rng.normal(size=3)
    return _jump(at, (across - speed * UP, across + keep * speed * UP), (w, w + rng.normal(size=3)), g)


def leaves_table(rng: np.random.Generator, at: float) -> Motion:
    """A sliding body falls from the edge of a table."""
    v, w = rng.normal(size=3) * [0.9, 0.9, 0], 1.5 * rng.normal(size=3)

    def path(t: np.ndarray) -> Poses:
        return v * t[:, None] - 5.0 * np.maximum(t - at, 0)[:, None] ** 2 * UP, _turned(w * t[:, None])

    return Motion(path, (at,))


def within(make: EventMaker, low: float, high: float) -> Maker:
    """A motion with an event between two times."""
    return lambda rng: make(rng, rng.uniform(low, high))


def left(make: EventMaker, poses: int) -> Maker:
    """A motion with a given number of observed poses after its event."""
    times = grid()
    low, step = times[POSES - poses - 1], times[1] - times[0]
    return lambda rng: make(rng, low + step * rng.uniform(0.05, 0.95))


def grid(poses: int = POSES) -> np.ndarray:
    """Observed times, evenly spaced with the last at `T_MAX`."""
    return np.linspace(0.0, T_MAX, poses)


def slipped(make: Maker, poses: int) -> Maker:
    """A motion whose last observed rotations slipped by a constant turn in the body's frame."""

    def slip(rng: np.random.Generator) -> Motion:
        motion = make(rng)
        return dataclasses.replace(motion, slip=math.radians(rng.uniform(15, 60)) * _direction(rng), slipped=poses)

    return slip


SIMPLE: dict[str, Maker] = {
    "steady": steady, "ballistic": ballistic, "hinge": hinge, "pendulum": pendulum, "circle": circle,
    "tumbling": tumbling,
}  # fmt: skip
MOTIONS: dict[str, Maker] = {
    **SIMPLE,
    "static": static,
    "slow": slow,
    "late start": within(starts, 0.15, 0.5),
    "collision": within(collides, 0.15, 0.55),
    "drag": drag,
    "fall with drag": falls_with_drag,
    "gyroscope": gyroscope,
    "friction, stops after t_max": rolls_until(0.8, 1.0),
    "friction, stops inside": rolls_until(0.35, 0.6),
    "friction, slides": slides_until(0.8, 1.0),
    "bounces": bounces,
    "one bounce": within(bounces_once, 0.25, 0.5),
    "damped spring": damped_spring,
    "damped pendulum": damped_pendulum,
    "Lissajous": lissajous,
    "double pendulum": double_pendulum,
    "slow Lissajous": slow_lissajous,
    "collision, 3 left": left(collides, 3),
    "late start, 3 left": left(starts, 3),
    "stop, 3 left": left(stops, 3),
    "one bounce, 3 left": left(bounces_once, 3),
    "falls from a table, 5 left": left(leaves_table, 5),
    "steady, last one slipped": slipped(steady, 1),
    "steady, last 3 slipped": slipped(steady, 3),
    "ballistic, last 3 slipped": slipped(ballistic, 3),
    "ballistic, last 5 slipped": slipped(ballistic, 5),
}


@dataclass(frozen=True)
class Noise:
    """Noise of observed poses.

    Attributes:
        place: Standard deviation per component, in body sizes (2 `RADIUS`).
        degrees: The same of rotations.
        correlation: Correlation with the previous pose.
        outliers: Share of poses that are ten times as noisy.
    """

    place: float
    degrees: float
    correlation: float = 0.0
    outliers: float = 0.0


NOISES = {
    "white": Noise(0.005, 0.8),
    "correlated": Noise(0.005, 0.8, correlation=0.7),
    "heavy": Noise(0.005, 0.8, outliers=0.05),
    "coarse": Noise(0.02, 3.0),
    "low": Noise(0.001, 0.2),
}


@dataclass(frozen=True)
class Draw:
    """An observed track and its true future.

    Attributes:
        times: Observed times. [S]
        places: Observed places. [S, 3]
        turns: Observed rotations. [S]
        later: Times after `T_MAX`; the last is 1. [H]
        true_places: True places there. [H, 3]
        true_turns: True rotations there. [H]
        motion: The motion.
        inertia: Inertia of the body in its last observed pose, world axes. [3, 3]
    """

    times: np.ndarray
    places: np.ndarray
    turns: Rotation
    later: np.ndarray
    true_places: np.ndarray
    true_turns: Rotation
    motion: Motion
    inertia: np.ndarray


def draw(name: str, noise: Noise, seed: int, poses: int = POSES) -> Draw:
    """Observe a random motion of a kind; equal arguments give equal draws."""
    rng = np.random.default_rng([seed, sum(name.encode())])
    motion = MOTIONS[name](rng)
    times = grid(poses)
    later = np.linspace(T_MAX, 1.0, 6)[1:]
    places, turns = motion.path(times)
    matrix = turns[-1].as_matrix()
    values = rng.normal(size=(poses, 6))
    rho = noise.correlation
    for i in range(1, poses):
        values[i] = rho * values[i - 1] + math.sqrt(1 - rho**2) * values[i]
    values *= np.where(rng.uniform(size=(poses, 1)) < noise.outliers, 10.0, 1.0)
    slip = np.where(np.arange(poses)[:, None] >= poses - motion.slipped, motion.slip, 0.0)
    return Draw(
        times,
        places + noise.place * 2 * RADIUS * values[:, :3],
        _turned(math.radians(noise.degrees) * values[:, 3:]) * turns * _turned(slip),
        later,
        *motion.path(later),
        motion,
        matrix @ box_inertia() @ matrix.T,
    )


def errors(places: np.ndarray, turns: Rotation, truth: Draw) -> np.ndarray:
    """Root mean square error over the surface of the body's ball at the later times, in % of its size. [H]"""
    angle = (turns * truth.true_turns.inv()).magnitude()
    turned = 2 / 3 * (2 * RADIUS * np.sin(0.5 * angle)) ** 2
    return 50 / RADIUS * np.sqrt(((places - truth.true_places) ** 2).sum(-1) + turned)
