"""Parameters of the scenes, drawn from ranges. Needs no Blender.

Lengths are in units, times in seconds. The ground is at z = 0, and the bodies move about the origin.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field

SECONDS = 1.2
"""Length of the timeline, t = 0 to 1."""

T_MAX = 0.6
"""Last observed time, as a share of the timeline."""

SEED = 22
_G = 9.81
_END = T_MAX * SECONDS
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class BodyParameters:
    """A body and its state at the first frame.

    Attributes:
        name: Name of the object.
        size: Edge lengths of a box, or (radius,) of a ball.
        density: Mass over volume.
        friction: Coulomb coefficient on the ground.
        restitution: That on the ground.
        place: Centre.
        velocity: Velocity.
        spin: Angular velocity in the world.
        turn: Axis and angle of its rotation, rad.
    """

    name: str
    size: tuple[float, ...]
    density: float
    friction: float
    restitution: float
    place: Triple
    velocity: Triple = (0.0, 0.0, 0.0)
    spin: Triple = (0.0, 0.0, 0.0)
    turn: tuple[Triple, float] = ((0.0, 0.0, 1.0), 0.0)


@dataclass(frozen=True)
class SceneParameters:
    """A scene.

    Attributes:
        name: Name, of the number and the kind.
        bodies: Its bodies; object ids are their positions from 1.
        table: Centre and edge lengths of a table top in x and y, and its height; None for the ground alone.
        azimuth_deg: Direction of the middle of the cameras.
        elevation_deg: Their elevation.
        told: What the observed motion determines: "friction", "restitution".
    """

    name: str
    bodies: tuple[BodyParameters, ...]
    azimuth_deg: float
    elevation_deg: float
    table: tuple[float, float, float, float, float] | None = None
    told: tuple[str, ...] = field(default=())


def draw(number: int, seed: int = SEED, attempt: int = 0) -> SceneParameters:
    """Draw the parameters of scene 0 to 11. Each attempt gives others."""
    rng, kind = random.Random(f"{seed} {number} {attempt}"), KINDS[number]
    bodies, table, told = _DRAWN[kind](rng)
    azimuth, elevation = rng.uniform(-180, 180), rng.uniform(20, 32)
    return SceneParameters(f"{number:02d}_{kind}", bodies, azimuth, elevation, table, told)


_Drawn = tuple[tuple[BodyParameters, ...], tuple[float, float, float, float, float] | None, tuple[str, ...]]


def _bounce(rng: random.Random) -> _Drawn:
    """A ball that touches the ground once while it is observed, and once after."""
    first, second = rng.uniform(0.25, 0.4), rng.uniform(0.82, 1.0)
    ball = _bouncing("ball", rng, first, second, rng.uniform(0, math.tau), rng.uniform(0.3, 0.8))
    return (ball,), None, ("restitution",)


def _bouncing(
    name: str,
    rng: random.Random,
    first: float,
    second: float,
    heading: float,
    speed: float,
    meet: float = 0.5 * SECONDS,
    short: float = 0.0,
    spinning: bool = True,
) -> BodyParameters:
    """A ball with two impacts at given times, which is ``short`` of the origin at the time ``meet``."""
    radius, restitution = rng.uniform(0.2, 0.26), rng.uniform(0.55, 0.8)
    impact = (second - first) * _G / (2 * restitution)
    height = radius + impact * first - 0.5 * _G * first**2
    along = (math.cos(heading), math.sin(heading))
    back = -speed * meet - short
    spin = tuple(rng.uniform(-4, 4) for _ in range(3)) if spinning else _rolling(along, speed, radius)
    return BodyParameters(
        name,
        (radius,),
        1.0,
        rng.uniform(0.2, 0.6),
        restitution,
        (back * along[0], back * along[1], height),
        (speed * along[0], speed * along[1], -(impact - _G * first)),
        spin,
    )


def _tumble(rng: random.Random) -> _Drawn:
    """A box that lands on an edge while it is observed, and tumbles to rest after it."""
    size = tuple(rng.uniform(0.3, 0.45) for _ in range(3))
    heading, landing, speed = rng.uniform(0, math.tau), rng.uniform(0.5, 0.62), rng.uniform(0.5, 1.0)
    tilt = math.radians(rng.uniform(25, 55))
    axis = (-math.sin(heading), math.cos(heading), 0.0)
    spin = rng.uniform(1.0, 5.0)
    angle = tilt - spin * landing
    up = rng.uniform(1.0, 1.8)
    low = 0.5 * (size[0] * math.sin(tilt) + size[2] * math.cos(tilt))
    height = low + 0.5 * _G * landing**2 - up * landing
    back = -0.5 * speed * SECONDS
    box = BodyParameters(
        "box",
        size,
        1.0,
        rng.uniform(0.2, 0.6),
        rng.uniform(0.1, 0.4),
        (back * math.cos(heading), back * math.sin(heading), height),
        (speed * math.cos(heading), speed * math.sin(heading), up),
        (axis[0] * spin, axis[1] * spin, 0.0),
        (axis, angle),
    )
    return (box,), None, ("friction",)


def _pair(rng: random.Random) -> _Drawn:
    """Two balls that bounce once, and then meet in the air."""
    first, second, meet = rng.uniform(0.25, 0.35), rng.uniform(0.95, 1.1), rng.uniform(0.8, 0.88)
    heading, turn = rng.uniform(0, math.tau), rng.uniform(-0.5, 0.5)
    balls = [
        _bouncing(f"ball {k + 1}", rng, first, second, angle, rng.uniform(0.5, 0.8), meet, 0.2, spinning=False)
        for k, angle in enumerate((heading, heading + math.pi + turn))
    ]
    return tuple(balls), None, ("restitution",)


def _trio(rng: random.Random) -> _Drawn:
    """Two balls that roll into a standing box, one after the other."""
    side, heading = rng.uniform(0.3, 0.4), rng.uniform(0, math.tau)
    box = BodyParameters(
        "box",
        (side, side, side),
        1.0,
        rng.uniform(0.3, 0.6),
        rng.uniform(0.2, 0.5),
        (0.0, 0.0, 0.5 * side),
        turn=((0.0, 0.0, 1.0), heading),
    )
    balls = []
    for k, quarter in enumerate((0, 1)):
        radius, speed = rng.uniform(0.18, 0.24), rng.uniform(0.8, 1.2)
        hit, angle = rng.uniform(0.76, 0.9), heading + quarter * 0.5 * math.pi
        along = (math.cos(angle), math.sin(angle))
        back = -(0.5 * side + radius + speed * hit)
        balls.append(
            BodyParameters(
                f"ball {k + 1}",
                (radius,),
                rng.uniform(0.8, 1.25),
                rng.uniform(0.3, 0.6),
                rng.uniform(0.4, 0.7),
                (back * along[0], back * along[1], radius),
                (speed * along[0], speed * along[1], 0.0),
                _rolling(along, speed, radius),
            )
        )
    return (box, *balls), None, ()


def _slide(rng: random.Random) -> _Drawn:
    """A box that slides and stops after it was observed."""
    size = (rng.uniform(0.4, 0.55), rng.uniform(0.35, 0.5), rng.uniform(0.22, 0.3))
    friction, stop, heading = rng.uniform(0.12, 0.3), rng.uniform(0.85, 1.05), rng.uniform(0, math.tau)
    speed = friction * _G * stop
    back = -0.3 * speed * stop
    box = BodyParameters(
        "box",
        size,
        1.0,
        friction,
        rng.uniform(0.1, 0.4),
        (back * math.cos(heading), back * math.sin(heading), 0.5 * size[2]),
        (speed * math.cos(heading), speed * math.sin(heading), 0.0),
        turn=((0.0, 0.0, 1.0), rng.uniform(0, math.tau)),
    )
    return (box,), None, ("friction",)


def _table(rng: random.Random) -> _Drawn:
    """A ball that rolls off the edge of a table after it was observed."""
    radius, speed, heading = rng.uniform(0.18, 0.24), rng.uniform(0.8, 1.3), rng.choice((0.0, 0.5, 1.0, 1.5)) * math.pi
    leave, height, width = rng.uniform(0.76, 0.84), rng.uniform(0.5, 0.7), rng.uniform(0.9, 1.1)
    length = speed * leave + 0.6
    along = (math.cos(heading), math.sin(heading))
    edges = (length, width) if abs(along[0]) > 0.5 else (width, length)
    start = 0.5 * length - speed * leave
    ball = BodyParameters(
        "ball",
        (radius,),
        1.0,
        rng.uniform(0.3, 0.6),
        rng.uniform(0.4, 0.7),
        ((start - 0.35) * along[0], (start - 0.35) * along[1], height + radius),
        (speed * along[0], speed * along[1], 0.0),
        _rolling(along, speed, radius),
    )
    return (ball,), (-0.35 * along[0], -0.35 * along[1], *edges, height), ()


def _rolling(along: tuple[float, float], speed: float, radius: float) -> Triple:
    return (-along[1] * speed / radius, along[0] * speed / radius, 0.0)


_DRAWN: dict[str, Callable[[random.Random], _Drawn]] = {
    "bounce": _bounce,
    "tumble": _tumble,
    "pair": _pair,
    "trio": _trio,
    "slide": _slide,
    "table": _table,
}
KINDS = ("bounce", "tumble", "pair", "slide", "table", "trio", "bounce", "tumble", "pair", "slide", "table", "trio")
"""Kind of each scene. The last four are for judging: nothing was chosen by them."""
