"""Stability cases on simulated contacts; none without MuJoCo. Lengths in m, g = 9.81 m/s^2."""

from __future__ import annotations

import functools
import importlib.util
import itertools
import math

import numpy as np

from .. import errors
from ..contact import recording, scene_world, simulation, stepping, world
from ..contact.world import Body, Material, Plane, State, World
from ..motion import rotations
from ..shapes import convex_hull, directions, solid
from .cases import Case

_G, _SIZE = 9.81, 0.1
_FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
_DOWN = np.array([0.0, 0.0, -_G])
_FINITE = "no number is infinite or NaN"
_ENERGY = "largest energy / that at the start - 1"
_ENERGY_ERROR = "elastic impacts at w dt = 0.1 change energy by up to 1 %"


def _box(center: object, sides: tuple[float, float, float] = (_SIZE, _SIZE, _SIZE), **options: float) -> Body:
    corners = 0.5 * np.array(list(itertools.product(*[(-side, side) for side in sides])))
    return _body(corners + np.asarray(center, float), **options)


def _ball(center: object, **options: float) -> Body:
    return _body(0.5 * _SIZE * directions.sphere(100) + np.asarray(center, float), **options)


def _body(points: np.ndarray, friction: float = 0.3, restitution: float = 0.3, density: float = 1.0) -> Body:
    return Body(solid.of(points), Material(friction, restitution), density=density)


def _run(
    place: World, duration: float, speed: float = 1.0, velocities: object = 0.0, spins: object = 0.0
) -> recording.Recording:
    """Record bodies that start in the bind state with rates [B, 3]."""
    size = min(body.solid.size for body in place.bodies)
    state = world.at_rest(place)
    state.velocities[:], state.spins[:] = np.asarray(velocities, float), np.asarray(spins, float)
    chosen = stepping.choose(speed, size, float(np.linalg.norm(place.gravity)), duration)
    runs = simulation.Simulation(place, chosen)
    found = recording.record(runs, state, duration)
    if runs.failed:
        raise ArithmeticError("MuJoCo reset the state")
    return found


def _mass_ratio(density: float) -> float:
    """Largest sinking of two boxes that stand on each other for 2 s, over their size."""
    place = World((_box([0, 0, 0.05]), _box([0, 0, 0.15], density=density)), _FLOOR, _DOWN)
    found = _run(place, 2.0)
    return float(np.abs(found.places - found.places[0]).max() / _SIZE)


def _stack() -> float:
    """Largest shift of five boxes that stand on each other for 10 s, over their size."""
    place = World(tuple(_box([0, 0, 0.05 + 0.1 * k], restitution=0.1) for k in range(5)), _FLOOR, _DOWN)
    runs = simulation.Simulation(place, stepping.choose(0.1, _SIZE, _G, 10.0))
    _, places = runs.poses(world.at_rest(place), np.linspace(1.0, 10.0, 4))
    return float(np.abs(places - np.array([body.solid.center for body in place.bodies])).max() / _SIZE)


def _tunnelling(speed: float) -> float:
    """Depth to which a plate of 4 mm passes through a wall of 2 mm, over its thickness."""
    wall = Body(_box([0, 0, 0], (0.002, 0.5, 0.5)).solid, fixed=True)
    place = World((_box([0.1, 0.01, 0.02], (0.004, 0.1, 0.1)), wall), None, np.zeros(3))
    found = _run(place, 0.2 / speed + 0.01, speed, velocities=[[-speed, 0, 0], [0, 0, 0]])
    return float(max(-found.places[:, 0, 0].min(), 0.0) / 0.004)


def _overlap(share: float) -> float:
    """Largest speed of two boxes that overlap by a share of their size and are taken apart, over sqrt(g size)."""
    place = World((_box([0, 0, 0.05]), _box([(1 - share) * _SIZE, 0, 0.05])), _FLOOR, _DOWN)
    found = _run(scene_world.apart(place), 1.0)
    return float(np.linalg.norm(found.velocities, axis=-1).max() / math.sqrt(_G * _SIZE))


def _frictionless() -> float:
    """Relative change of the speed of a box that slides for 2 s without friction."""
    found = _run(World((_box([0, 0, 0.05], friction=0.0),), _FLOOR, _DOWN), 2.0, 0.1, [[1.0, 0.5, 0]])
    return float(np.linalg.norm(found.velocities[-1, 0] - [1.0, 0.5, 0]) / math.hypot(1.0, 0.5))


def _sticking() -> float:
    """Slip in 2 s of a flat box of infinite friction on a slope of 45 degrees, over its size."""
    gravity = _G * np.array([math.sqrt(0.5), 0, -math.sqrt(0.5)])
    found = _run(World((_box([0, 0, 0.01], (0.1, 0.1, 0.02), friction=1e9),), _FLOOR, gravity), 2.0)
    return float(np.linalg.norm(found.places[-1, 0] - found.places[0, 0]) / _SIZE)


def _bouncing(e: float) -> float:
    """Gain of energy of a box that falls and tumbles for 2 s."""
    box = _box([0, 0, 0.4], restitution=e)
    return _gain(box, _run(World((box,), _FLOOR, _DOWN), 2.0, 3.0, [[0.7, 0.2, 0]], [[3.0, 5.0, 1.0]]))


def _coin() -> float:
    """Gain of energy of a coin that spins on its edge with 60 rad/s and falls over."""
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = 0.05 * np.stack([np.zeros(24), np.cos(angles), np.sin(angles)], axis=1)
    coin = _body(np.concatenate([rim + [0.002, 0, 0.0505], rim - [0.002, 0, -0.0505]]))
    return _gain(coin, _run(World((coin,), _FLOOR, _DOWN), 1.0, 4.0, spins=[[0.5, 0, 60.0]]))


def _gain(body: Body, found: recording.Recording) -> float:
    """Largest energy of a single body over that at the start, over the floor, minus 1."""
    shape = body.solid
    own = rotations.rotate(rotations.conjugate(found.quats[:, 0]), found.spins[:, 0])
    inertia = shape.inertia if body.ball_radius is None else 0.4 * shape.volume * body.ball_radius**2 * np.eye(3)
    turning = 0.5 * np.einsum("ni,ij,nj->n", own, inertia, own)
    moving = 0.5 * shape.volume * (found.velocities[:, 0] ** 2).sum(axis=1)
    energy = turning + moving + shape.volume * _G * found.places[:, 0, 2]
    return float(energy.max() / energy[0] - 1)


def _floating() -> float:
    """Error of the place of a box that drifts and spins for 10 s without gravity, over its size."""
    place = World((_box([0, 0, 1.0]),), _FLOOR, np.zeros(3))
    runs = simulation.Simulation(place, stepping.choose(1.0, _SIZE, 0.0, 10.0))
    start = world.at_rest(place)
    state = State(start.places, start.quats, np.array([[0.3, 0.1, 0.05]]), np.array([[1.0, 2.0, 3.0]]))
    _, places = runs.poses(state, np.array([10.0]))
    return float(np.linalg.norm(places[0, 0] - start.places[0] - 10 * state.velocities[0]) / _SIZE)


def _three_gaussians() -> float:
    """Numbers that are not finite in the fall of a body of three Gaussians."""
    means = np.array([[0, 0, 0.2], [0.1, 0, 0.2], [0, 0.1, 0.25]])
    quats, scales = np.tile([1.0, 0, 0, 0], (3, 1)), np.full((3, 3), 0.02)
    points = convex_hull.vertices(means, quats, scales, np.ones(3))
    return _not_finite(_run(World((_body(points),), _FLOOR, _DOWN), 1.0, 2.0))


def _degenerate() -> float:
    """Hulls, flat, thin or of few points, that neither give the error of a hull nor fall with finite numbers."""
    flat = _box([0, 0, 0.2]).solid.vertices * [1, 1, 0]
    needle, sheet = (_box([0, 0, 0.2], sides).solid.vertices for sides in ((0.1, 1e-5, 1e-5), (0.1, 0.1, 1e-5)))
    bad = 0.0
    for points in (flat, flat[:3], np.zeros((8, 3)), np.full((5, 3), 0.3), needle, sheet):
        try:
            bad += _not_finite(_run(World((_body(points),), _FLOOR, _DOWN), 0.2, 2.0)) > 0
        except errors.ConfigError:
            continue
    return bad


def _not_finite(found: recording.Recording) -> float:
    return float(sum((~np.isfinite(part)).sum() for part in (found.places, found.quats, found.velocities, found.spins)))


_RECORD = "contact.recording.record"
_STATE = "contact.simulation.Simulation.poses"
_ALL: tuple[Case, ...] = (
    *(
        Case("contacts", f"mass ratio {density:g}", _RECORD, "sinking / size", 0.02, "solimp of 0.99", measure)
        for density in (1e-6, 1e-3, 1e3, 1e6)
        for measure in (functools.partial(_mass_ratio, density),)
    ),
    Case("contacts", "five boxes on each other for 10 s", _STATE, "shift / size", 1e-3, "sagging of 1e-3", _stack),
    *(
        Case("contacts", f"thin plate at a thin wall, {speed:g} m/s", _RECORD, "depth / thickness", 1.0, "not through",
             functools.partial(_tunnelling, speed))
        for speed in (1.0, 10.0, 30.0, 100.0)
    ),
    *(
        Case("contacts", f"boxes that overlap by {share:.0%}", "contact.scene_world.apart, " + _RECORD,
             "speed / sqrt(g size)", 0.5, "they part at a walking pace", functools.partial(_overlap, share))
        for share in (0.05, 0.5)
    ),
    Case("contacts", "no friction", _RECORD, "relative change of speed", 1e-3, "friction of 1e-5", _frictionless),
    Case("contacts", "infinite friction on a slope", _RECORD, "slip / size", 0.02, "soft friction creeps", _sticking),
    *(
        Case("contacts", f"restitution {e:g}", _RECORD, _ENERGY, 0.02, _ENERGY_ERROR, functools.partial(_bouncing, e))
        for e in (0.0, 1.0)
    ),
    Case("contacts", "coin that spins with 60 rad/s", _RECORD, _ENERGY, 0.02, _ENERGY_ERROR, _coin),
    Case("contacts", "body of three Gaussians", _RECORD, "numbers that are not finite", 0.0, _FINITE, _three_gaussians),
    Case("contacts", "flat, thin and empty hulls", _RECORD, "hulls without error or result", 0.0, _FINITE, _degenerate),
    Case("contacts", "no gravity for 10 s", _STATE, "error of the place / size", 1e-6, "straight line", _floating),
)  # fmt: skip
CASES = _ALL if importlib.util.find_spec("mujoco") is not None else ()
