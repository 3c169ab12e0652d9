"""Scenes of moving bodies with known poses, written as data sets; parameters and textures are drawn from a seed.

| scene | objects |
|---|---|
| balls | two balls collide; a third one bounces twice |
| sliders | a box at rest starts late; a drum is slowed by drag; a ball rolls until it stops |
| spinners | a gyroscope precesses; a ring with a periodic texture rolls; a ball without texture slides |
| hidden | a box appears late; a ball passes behind a screen for a third of the time |
| arm | two links, one id each |
| one_arm | the same links under one id |
| flag | a strip that waves, of ten slabs under one id |
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from r5dgs_core.data import images
from r5dgs_core.scene import cameras

from . import ray_tracer
from .ray_tracer import Distance, Solid, Texture

T_MAX, KNOTS, CAMERAS = 0.75, 13, 6
LATER = (0.78, 0.81, 0.84, 0.88, 0.92, 0.95, 0.98, 1.0)  # true poses after t_max
TEST = (0.84, 0.92, 1.0)  # those with images
SIZE, FIELD_OF_VIEW = 64, 0.52
UP = np.array([0.0, 0.0, 1.0])

Motion = Callable[[float], tuple[np.ndarray, Rotation]]  # time -> place [3] and rotation


@dataclass(frozen=True)
class Body:
    """A moving body.

    Attributes:
        name: Its name.
        object_id: Id in the masks.
        distance: Shape.
        texture: Texture.
        bound: Radius that holds it.
        path: Its poses.
        enters: Time before which it is not there.
    """

    name: str
    object_id: int
    distance: Distance
    texture: Texture
    bound: float
    path: Motion
    enters: float = -1.0


def _turned(rotvec: np.ndarray) -> Rotation:
    return Rotation.from_rotvec(rotvec)


def _linear(place: np.ndarray, v: np.ndarray, w: np.ndarray, clock: Callable[[float], float] = float) -> Motion:
    """Straight motion and spin, both by a common clock."""
    return lambda t: (place + v * clock(t), _turned(w * clock(t)))


def _heading(rng: np.random.Generator, low: float, high: float) -> np.ndarray:
    angle = rng.uniform(0, math.tau)
    return rng.uniform(low, high) * np.array([math.cos(angle), math.sin(angle), 0])


def _jump(at: float, place: np.ndarray, v: tuple[np.ndarray, ...], w: tuple[np.ndarray, ...]) -> Motion:
    """Straight motion whose velocity and spin change at a time, where the body is in ``place``."""

    def path(t: float) -> tuple[np.ndarray, Rotation]:
        k = int(t > at)
        return place + v[k] * (t - at), _turned(w[k] * (t - at))

    return path


def balls(rng: np.random.Generator) -> list[Body]:
    """Two rolling balls of equal mass collide without loss; a third one bounces twice."""
    r, at = 0.34, rng.uniform(0.3, 0.5)
    normal = _heading(rng, 1, 1)
    middle = np.array([-0.75, -0.6, r])
    v = [1.3 * normal + _heading(rng, 0, 0.5), -0.9 * normal + _heading(rng, 0, 0.5)]
    swap = ((v[1] - v[0]) @ normal) * normal
    after = [v[0] + swap, v[1] - swap]
    found = []
    for k, side in enumerate((-1, 1)):
        spins = tuple(np.cross(UP, x) / r for x in (v[k], after[k]))
        path = _jump(at, middle + side * r * normal, (v[k], after[k]), spins)
        found.append(Body(f"ball {k + 1}", k + 1, ray_tracer.ball(r), ray_tracer.patches(rng, 14), r, path))
    first, gap, keep, g = rng.uniform(0.12, 0.2), rng.uniform(0.38, 0.46), 0.8, rng.uniform(14, 18)
    hits = np.cumsum([first - gap / keep, gap / keep, gap, gap * keep, gap * keep**2])
    across, w = _heading(rng, 0.2, 0.6), [2.5 * rng.normal(size=3) for _ in range(2)]

    def bounce(t: float) -> tuple[np.ndarray, Rotation]:
        k = int(np.searchsorted(hits, t)) - 1
        since, speed = t - hits[k], 0.5 * g * gap * keep ** (k - 1)
        place = np.array([0.7, 0.8, 0.32 + speed * since - 0.5 * g * since**2]) + across * (t - first)
        return place, _turned(w[1] * max(t - hits[2], 0)) * _turned(w[0] * (min(t, hits[2]) - first))

    return [*found, Body("bouncing", 3, ray_tracer.ball(0.32), ray_tracer.patches(rng, 14), 0.32, bounce)]


def sliders(rng: np.random.Generator) -> list[Body]:
    """A late start, drag, and friction that stops a rolling ball."""
    start, stop, c, r = rng.uniform(0.25, 0.4), rng.uniform(0.45, 0.62), rng.uniform(3, 5), 0.33
    half, v = (0.36, 0.28, 0.3), _heading(rng, 0.9, 1.3)
    box = _jump(start, np.array([-0.8, -0.7, 0.3]), (0 * v, v), (0 * UP, rng.uniform(1, 2) * UP))
    push, spin = _heading(rng, 2.2, 3.0), rng.uniform(4, 7) * rng.choice([-1, 1]) * UP
    drag = _linear(np.array([0.9, -0.6, 0.2]) - 0.15 * push, push, spin, lambda t: -math.expm1(-c * t) / c)
    roll = _heading(rng, 1.4, 2.0)

    def clock(t: float) -> float:
        return min(t, stop) - min(t, stop) ** 2 / (2 * stop)

    stopping = _linear(np.array([0.0, 0.9, r]) - 0.25 * roll, roll, np.cross(UP, roll) / r, clock)
    return [
        Body("late", 1, ray_tracer.box(half), ray_tracer.patches(rng, 16), 0.56, box),
        Body("drag", 2, ray_tracer.drum(0.38, 0.2), ray_tracer.patches(rng, 16), 0.44, drag),
        Body("stopping", 3, ray_tracer.ball(r), ray_tracer.patches(rng, 14), r, stopping),
    ]


def spinners(rng: np.random.Generator) -> list[Body]:
    """Steady precession, a rolling ring of periodic texture, and a ball whose spin cannot be seen."""
    turn, spin, tilt = rng.uniform(2, 4), rng.uniform(5, 8) * rng.choice([-1, 1]), rng.uniform(0.3, 0.6)

    def gyroscope(t: float) -> tuple[np.ndarray, Rotation]:
        pose = _turned(turn * t * UP) * _turned(np.array([0, tilt, 0])) * _turned(spin * t * UP)
        return np.array([-0.7, -0.6, 0.12]) + pose.apply(0.4 * UP), pose

    v, upright = _heading(rng, 0.8, 1.2), _turned(np.array([math.pi / 2, 0, 0]))
    heading = _turned(math.atan2(v[1], v[0]) * UP)

    def rolling(t: float) -> tuple[np.ndarray, Rotation]:
        turned = _turned(np.cross(UP, v) / 0.42 * t) * heading * upright
        return np.array([0.8, -0.5, 0.42]) + v * (t - 0.4), turned

    slide = _heading(rng, 0.7, 1.1)
    sliding = _linear(np.array([0, 0.9, 0.3]) - 0.4 * slide, slide, 3 * rng.normal(size=3))
    return [
        Body("gyroscope", 1, ray_tracer.drum(0.4, 0.14), ray_tracer.patches(rng, 14), 0.43, gyroscope),
        Body("ring", 2, ray_tracer.ring(0.28, 0.14), ray_tracer.sectors(rng, 14), 0.43, rolling),
        Body("plain", 3, ray_tracer.ball(0.3), ray_tracer.plain(rng), 0.3, sliding),
    ]


def hidden(rng: np.random.Generator) -> list[Body]:
    """A box that appears late, and a ball that a screen hides from most cameras for a third of the time."""
    v, w = _heading(rng, 0.6, 1.0), 3 * rng.normal(size=3) / math.sqrt(3)
    flying = _linear(np.array([-0.6, -0.8, 0.75]) - 0.6 * v, v, w)
    r, across = 0.3, np.array([rng.uniform(1.8, 2.2), rng.uniform(-0.2, 0.2), 0.0])
    rolling = _linear(np.array([0.2, 0.75, r]) - 0.375 * across, across, np.cross(UP, across) / r)
    screen = np.array([0.2, 0.25, 0.4]), Rotation.identity()
    return [
        Body("entering", 1, ray_tracer.box((0.36, 0.28, 0.3)), ray_tracer.patches(rng, 16), 0.56, flying, 0.3),
        Body("behind", 2, ray_tracer.ball(r), ray_tracer.patches(rng, 14), r, rolling),
        Body("screen", 0, ray_tracer.box((0.38, 0.04, 0.4)), ray_tracer.patches(rng, 20), 0.56, lambda t: screen),
    ]


def _arm(rng: np.random.Generator, lower_id: int) -> list[Body]:
    """Two links on a post: the upper one turns about a fixed hinge, the lower one about its end."""
    lengths, w = (0.75, 0.65), (rng.uniform(0.8, 1.4), rng.uniform(1.5, 2.5) * rng.choice([-1, 1]))
    starts, axis = (rng.uniform(-0.6, 0.0), rng.uniform(-0.5, 0.5)), np.array([0, 1.0, 0])
    base = np.array([0.0, 0.0, 1.0])

    def link(k: int) -> Motion:
        def path(t: float) -> tuple[np.ndarray, Rotation]:
            turns = [
                _turned((starts[0] + w[0] * t) * axis),
                _turned((starts[0] + starts[1] + (w[0] + w[1]) * t) * axis),
            ]
            joint = base + turns[0].apply([lengths[0], 0, 0])
            ends = base if k == 0 else joint + [0, 0.2, 0]
            return ends + turns[k].apply([0.5 * lengths[k], 0, 0]), turns[k]

        return path

    return [
        Body(
            name,
            object_id,
            ray_tracer.box((0.5 * length + 0.06, 0.09, 0.12)),
            ray_tracer.patches(rng, 12),
            0.5 * length + 0.22,
            link(k),
        )
        for k, (name, object_id, length) in enumerate(
            (("upper", 1, lengths[0]), ("lower" if lower_id == 2 else "arm", lower_id, lengths[1]))
        )
    ]


def flag(rng: np.random.Generator) -> list[Body]:
    """A strip on a pole, bent by a wave that travels along it and grows towards its free end."""
    count, length = 10, 1.7
    amplitude, waves, speed = rng.uniform(0.25, 0.35), rng.uniform(3.0, 4.0), rng.uniform(5.0, 7.0)

    def slab(k: int) -> Motion:
        s = length * (k + 0.5) / count

        def path(t: float) -> tuple[np.ndarray, Rotation]:
            phase = waves * s - speed * t
            share = amplitude / length
            slope = share * (math.sin(phase) + waves * s * math.cos(phase))
            place = np.array([s - 0.5 * length, share * s * math.sin(phase), 0.6])
            return place, _turned(math.atan(slope) * UP)

        return path

    half = (0.5 * length / count + 0.02, 0.04, 0.4)
    return [
        Body(f"slab {k}" if k else "flag", 1, ray_tracer.box(half), ray_tracer.patches(rng, 12), 0.44, slab(k))
        for k in range(count)
    ]


SCENES: dict[str, Callable[[np.random.Generator], list[Body]]] = {
    "balls": balls,
    "sliders": sliders,
    "spinners": spinners,
    "hidden": hidden,
    "arm": lambda rng: _arm(rng, 2),
    "one_arm": lambda rng: _arm(rng, 1),
    "flag": flag,
}


def solids(bodies: Sequence[Body], t: float) -> list[Solid]:
    """Return the bodies that are there at a time, in their poses."""
    return [Solid(b.object_id, b.distance, b.texture, b.bound, *b.path(t)) for b in bodies if t >= b.enters]


def write(folder: Path, name: str, seed: int) -> None:
    """Render a scene into a data set; equal arguments give equal files.

    Args:
        folder: Where to.
        name: One of `SCENES`.
        seed: Seed of motions and textures.
    """
    rng = np.random.default_rng([seed, sum(name.encode())])
    bodies, ground = SCENES[name](rng), ray_tracer.floor(rng)
    times = np.linspace(0, T_MAX, KNOTS)
    plan = {
        "train": [(k, t) for t in times for k in range(CAMERAS)],
        "val": [(k + 0.5, t) for k in (1, 3) for t in times[[1, 4, 7, 10]]],
        "test": [(k, t) for k in (0, 2, 4.5) for t in TEST],
    }
    for split, wanted in plan.items():
        frames = []
        for i, (k, t) in enumerate(wanted):
            eye = camera(k)
            color, ids = ray_tracer.render(eye, solids(bodies, float(t)), ground)
            images.write_png(folder / split / f"r_{i:03d}.png", color)
            images.write_png(folder / "object_mask" / split / f"r_{i:03d}.png", ids)
            matrix = cameras.cam_world_to_opengl(eye.T_cam_world).tolist()
            frames.append({"file_path": f"./{split}/r_{i:03d}", "time": float(t), "transform_matrix": matrix})
        content = {"camera_angle_x": FIELD_OF_VIEW, "frames_per_unit": 60.0, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    names = {body.object_id: body.name for body in reversed(bodies) if body.object_id}
    rows = []
    every = [float(t) for t in (*times, *LATER)]
    for body in sorted((body for body in bodies if body.object_id), key=lambda body: body.object_id):
        matrices = []
        for t in every:
            matrix = np.eye(4)
            matrix[:3, 3], turn = body.path(t)
            matrix[:3, :3] = turn.as_matrix()
            matrices.append(matrix.tolist())
        rows.append({"id": body.object_id, "name": body.name, "matrices": matrices})
    (folder / "objects.json").write_text(json.dumps(names))
    (folder / "ground_truth.json").write_text(json.dumps({"t_max": T_MAX, "times": every, "objects": rows}))


def camera(k: float) -> cameras.Camera:
    """Return a camera on an arc of 190 degrees about the scene; k may lie between two cameras."""
    angle = math.radians(-185 + 190 * k / (CAMERAS - 1))
    target = np.array([0.0, 0.0, 0.4])
    height = 2.2 + 0.5 * math.sin(2.3 * k)
    place = np.array([4.6 * math.cos(angle), 4.6 * math.sin(angle), height])
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, UP) / np.linalg.norm(np.cross(forward, UP))
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ place
    focal = 0.5 * SIZE / math.tan(0.5 * FIELD_OF_VIEW)
    return cameras.Camera(SIZE, SIZE, np.array([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]]), matrix)
