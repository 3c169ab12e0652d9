"""Motion of a scene's bodies past t_max with contacts, if the smooth motion would pass through something."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..motion import history, rotations, se3
from ..motion_fit import band as bands
from ..scene import gravity, predictability, world_axes
from ..scene.scene import MotionGroup, Scene
from ..shapes import directions
from . import edges, futures, held_out, path_knots, recording, scene_bodies, scene_world, world
from .held_out import Comparison
from .recording import Recording
from .scene_bodies import SceneBody
from .scene_world import Wishes
from .simulation import Simulation

PENETRATION = 0.02  # of the size, by which a smooth motion passes through something before contacts are tried
BAND_LEVEL = 0.95
KNOTS = 16  # of a band
_BEYOND = 4.0  # time that is simulated if the bodies do not come to rest, over the time to the horizon
_TIMES = 64  # at which smooth motions are tested
_DIRECTIONS = directions.sphere(128)  # in which an overlap is measured, besides those of the faces


@dataclass(frozen=True)
class Prediction:
    """Result of `predict`.

    Attributes:
        groups: The scene's groups, those of bodies in contact with new motions.
        penetrations: Penetration of the smooth motion, in sizes, of each body that would pass through something.
        taken: Material in words of each body that got a motion with contacts, by name.
        compared: Test by held-out poses of those of them that needed one, by name.
        lines: Reasons for which other bodies keep their smooth motions, a sentence each.
        world: The simulated bodies.
        materials: Their materials.
        recording: The most likely future.
        leaving: Name of the body that moves off its support, or "".
    """

    groups: tuple[MotionGroup, ...]
    penetrations: Mapping[str, float]
    taken: Mapping[str, str]
    lines: tuple[str, ...]
    compared: Mapping[str, Comparison] = field(default_factory=dict)
    world: scene_world.SceneWorld | None = None
    materials: tuple[world.Material, ...] = ()
    recording: Recording | None = None
    leaving: str = ""


def predict(scene: Scene, wishes: Wishes | None = None) -> Prediction:
    """Predict motions with contacts.

    Args:
        scene: A scene with hulls.
        wishes: The user's changes. If it pushes a body, that body is simulated even without need.

    Raises:
        BackendError: Contacts are needed and MuJoCo is not installed.
    """
    return _predict(scene, wishes or Wishes(), with_edges=True)


def _predict(scene: Scene, wishes: Wishes, *, with_edges: bool) -> Prediction:
    """Predict motions with contacts, with or without edges of supports."""
    bodies, lines = scene_bodies.of(scene)
    bodies = [body for body in bodies if body.group.id not in wishes.ignored]
    bodies += scene_bodies.obstacles(scene, wishes.obstacles)
    if not any(body.moves for body in bodies) and not wishes.pushes:
        return Prediction(scene.groups, {}, {}, tuple(lines))
    end = predictability.horizon(scene) if wishes.until is None else wishes.until
    pull = gravity.of(scene) if wishes.gravity is None else wishes.gravity
    up = world_axes.UP_AXIS.get(scene.world_convention)
    passing, sinking = _passing(scene, bodies, end, up)
    depths = {bodies[number].name: depth for number, depth in passing.items()}
    pushed = {number for number, body in enumerate(bodies) if body.group.id in wishes.pushes}
    doubtful = _doubtful(scene, bodies, passing, end, up) - pushed
    driven = [n for n in passing if bodies[n].reason and n not in pushed | doubtful]
    lines += [f"{bodies[n].name}: keeps its smooth motion: {bodies[n].reason}" for n in driven]
    tried = (set(passing) - set(driven)) | pushed | doubtful
    free = [n for n, body in enumerate(bodies) if (n not in tried or n in doubtful) and _is_free(scene, body)]
    leave = edges.first(scene, bodies, free, end, up) if with_edges and up is not None else None
    leaving = set() if leave is None else {leave.number}
    tried |= leaving
    doubtful |= {n for n in leaving if bodies[n].reason}
    if not tried:
        return Prediction(scene.groups, depths, {}, tuple(lines))
    if pull is None or up is None:
        reason = "gravity is unknown: no body was seen to fall, and the scene has no up axis or no units"
        return Prediction(scene.groups, depths, {}, (*lines, f"no contacts are predicted: {reason}"))
    judged = {n: n in leaving or n in passing and not held_out.is_unexplained(scene, bodies[n]) for n in doubtful}
    sinking -= leaving | pushed
    made = scene_world.make(scene, bodies, tried, pushed, judged, pull, end, leave, sinking).weighted(wishes.masses)
    found = _simulated(scene, made, wishes, end, depths, [*lines, *made.lines])
    if leave is None:
        return found
    name = bodies[leave.number].name
    if name in found.taken and not _falls(found, name):  # friction stops it before the edge
        return _predict(scene, wishes, with_edges=False)
    return dataclasses.replace(found, leaving=name)


def _falls(found: Prediction, name: str) -> bool:
    """Return True if the centre of a body sinks below its support in the simulation."""
    assert found.world is not None and found.recording is not None and found.world.world.plane is not None
    number, support = [body.name for body in found.world.bodies].index(name), found.world.world.plane
    return bool((found.recording.places[:, number] @ support.normal).min() < support.height)


def _simulated(
    scene: Scene,
    made: scene_world.SceneWorld,
    wishes: Wishes,
    end: float,
    depths: Mapping[str, float],
    lines: list[str],
) -> Prediction:
    """Simulate the bodies together, and give new motions to those that touch something."""
    if not made.fits and not wishes.pushes:
        return Prediction(scene.groups, depths, {}, tuple(lines))
    materials = [
        wishes.material(b.group.id, own.material) for b, own in zip(made.bodies, made.world.bodies, strict=True)
    ]
    state = made.start(scene.t_max)
    for number, body in enumerate(made.bodies):
        state.velocities[number] += wishes.pushes.get(body.group.id, np.zeros(3))
    duration = end - scene.t_max
    runs = Simulation(made.world, made.stepping(state, duration))
    runs.set_materials(materials)
    found = recording.record(runs, state, _BEYOND * duration)  # it ends when all bodies rest
    if runs.failed:
        return Prediction(scene.groups, depths, {}, (*lines, "no contacts are predicted: the simulation failed"))
    changed = _changed(made, found, {n for n, b in enumerate(made.bodies) if b.group.id in wishes.pushes})
    untouched = set(made.fits) - changed
    lines += [f"{made.bodies[n].name}: touches nothing in the simulation" for n in sorted(untouched)]
    times = np.linspace(0, duration, KNOTS)
    sampled = made.sample(scene.t_max, times, materials, wishes) if changed else {}
    groups = list(scene.groups)
    for number in changed:
        group = made.bodies[number].group
        groups[group.id] = _with_contact(group, made, number, found, sampled.get(number), scene.t_max)
    taken = {made.bodies[n].name: made.text(n, materials[n]) for n in sorted(changed)}
    compared = {made.bodies[n].name: made.comparisons[n] for n in sorted(changed & made.comparisons.keys())}
    return Prediction(tuple(groups), depths, taken, tuple(lines), compared, made, tuple(materials), found)


def _changed(made: scene_world.SceneWorld, found: Recording, pushed: set[int]) -> set[int]:
    """Numbers of the bodies that were fitted and touch something, or that such a body touches."""
    hit = {number for touch in found.touches for number in touch.bodies}
    changed = {number for number in made.fits if number in hit} | pushed
    while True:
        more = {n for touch in found.touches if changed & set(touch.bodies) for n in touch.bodies if n >= 0} - changed
        more = {n for n in more if not made.world.bodies[n].fixed}
        if not more:
            return {n for n in changed if made.bodies[n].group.id}
        changed |= more


def _with_contact(
    group: MotionGroup,
    made: scene_world.SceneWorld,
    number: int,
    found: Recording,
    sampled: futures.Futures | None,
    t_max: float,
) -> MotionGroup:
    body, smooth = made.bodies[number], group.smooth or group.model
    center = made.world.bodies[number].solid.center
    model = path_knots.model(found, number, center, group.pivot, body.solid.size, smooth.fade_time)
    model = dataclasses.replace(model, radius=smooth.radius)
    past = group.history
    if sampled is not None and sampled.quats.shape[1]:
        own = None if number in made.fits else past.band  # nothing else tells its uncertainty at t_max
        past = dataclasses.replace(past, band=_band(sampled, found, number, body.solid.size, t_max, own))
    return dataclasses.replace(group, model=model, smooth=smooth, history=past)


def _band(
    sampled: futures.Futures, found: Recording, number: int, size: float, t_max: float, own: history.Band | None
) -> history.Band:
    """Band of the samples of a body; ``own`` is that of its smooth motion if the samples start in one state."""
    rows, times = np.minimum(np.searchsorted(found.times, sampled.times), len(found.times) - 1), t_max + sampled.times
    widths = sampled.radii(found.places[rows, number], BAND_LEVEL)
    angles = sampled.angles(found.quats[rows, number], BAND_LEVEL)
    if own is not None:
        widths, angles = np.hypot(widths, own.widths(times)), np.hypot(angles, own.angles(times))
    angles = np.minimum(angles, np.pi)
    band = history.Band(tuple(times.tolist()), tuple(widths.tolist()), tuple(angles.tolist()), BAND_LEVEL)
    return bands.trusted(band, 0.5 * size)


def _passing(
    scene: Scene, bodies: list[SceneBody], end: float, up: np.ndarray | None
) -> tuple[dict[int, float], set[int]]:
    """Penetration, in sizes, of the smooth motion of each body that passes through the plane or another body.

    Returns:
        The penetrations by number, and the numbers of bodies that pass through the plane alone.
    """
    tau = np.linspace(0, max(end - scene.t_max, 0.0), _TIMES)
    paths = [scene_bodies.predicted(body, tau) for body in bodies]
    moving = [number for number, body in enumerate(bodies) if body.moves]
    found: dict[int, float] = {}
    places, reach = np.array([path[1] for path in paths]), np.array([_radius(body) for body in bodies])
    for number in moving:
        apart = np.linalg.norm(places - places[number], axis=2).min(axis=1)
        others = (n for n in np.flatnonzero(apart <= reach + reach[number]).tolist() if n != number)
        depths = [_overlap(bodies[number], paths[number], bodies[n], paths[n]) for n in others]
        found[number] = max(depths, default=0.0)
    # A law of bounces has its own floor, from the impacts that were seen.
    landing = [n for n in moving if bodies[n].smooth.kind != "bounce"]
    sinking = [] if up is None else [n for n in landing if _sinks(scene, bodies[n], paths[n], up)]
    plane = scene_world.plane(scene, bodies, end, up) if sinking and up is not None else None
    hitting = {number for number, depth in found.items() if depth > PENETRATION * bodies[number].solid.size}
    for number in sinking if plane is not None else ():
        assert plane is not None
        body, track = world.Body(bodies[number].solid), scene_bodies.track(scene, bodies[number])
        lowest = float(world.gaps(body, plane, track.places, track.quats).min(initial=0.0))
        found[number] = max(
            found[number], lowest - float(world.gaps(body, plane, paths[number][1], paths[number][0]).min())
        )
    sizes = {number: bodies[number].solid.size for number in found}
    deep = {number: depth / sizes[number] for number, depth in found.items() if depth > PENETRATION * sizes[number]}
    return deep, deep.keys() - hitting


def _doubtful(
    scene: Scene, bodies: list[SceneBody], passing: Mapping[int, float], end: float, up: np.ndarray | None
) -> set[int]:
    """Numbers of bodies that get contacts only if held-out poses support them.

    All of them are close to the plane. Of some, no smooth law explains the last poses; a law of a driven body that does
    not fit is no evidence of a hand or a motor. The others pass through something by the law of a driven body, but
    contacts may explain their poses, too.
    """
    asked = [n for n, body in enumerate(bodies) if n not in passing or body.reason]
    tested = [n for n in asked if held_out.is_possible(scene, bodies[n])]
    found = [n for n in tested if n in passing or held_out.is_unexplained(scene, bodies[n])]
    if not found or up is None:
        return set()
    plane = scene_world.plane(scene, bodies, end, up)
    return {n for n in found if held_out.in_contact(scene, bodies[n], plane)}


def _is_free(scene: Scene, body: SceneBody) -> bool:
    """Return True if a body moves without a hand or a motor, or if held-out poses can show that."""
    return held_out.is_possible(scene, body) if body.reason else body.moves


def _sinks(scene: Scene, body: SceneBody, path: se3.Pose, up: np.ndarray) -> bool:
    """Return True if a body is predicted to be lower than it was ever seen, or was not seen."""
    track, flat = scene_bodies.track(scene, body), world.Plane(up, 0.0)
    seen, ahead = (
        float(world.gaps(world.Body(body.solid), flat, places, quats).min(initial=np.inf))
        for quats, places in ((track.quats, track.places), path)
    )
    return ahead < seen - PENETRATION * body.solid.size


def _overlap(body: SceneBody, path: se3.Pose, other: SceneBody, others_path: se3.Pose) -> float:
    """Largest increase of the overlap of two bodies since t_max: the smallest of many shifts that separate them."""
    apart = others_path[1] - path[1]
    lines = apart / np.maximum(np.linalg.norm(apart, axis=1), 1e-12)[:, None]
    turns, others_turns = rotations.quats_to_rotmats(path[0]), rotations.quats_to_rotmats(others_path[0])
    normals, others_normals = body.solid.normals, other.solid.normals

    def depth(time: int, towards: np.ndarray) -> float:
        own, others = _reach(body, towards @ turns[time]), _reach(other, -towards @ others_turns[time])
        return float((own + others - towards @ apart[time]).min())

    depths = np.array([depth(time, lines[time : time + 1]) for time in range(len(apart))])
    for time in np.flatnonzero(depths >= 0).tolist():  # elsewhere, they do not overlap
        faces = normals @ turns[time].T, -others_normals @ others_turns[time].T
        depths[time] = min(depths[time], depth(time, np.concatenate([_DIRECTIONS, *faces])))
    return float((depths - max(depths[0], 0.0)).max())


def _radius(body: SceneBody) -> float:
    """Radius of the ball about a body's centre that contains it."""
    return float(np.linalg.norm(body.solid.vertices - body.solid.center, axis=1).max())


def _reach(body: SceneBody, towards: np.ndarray) -> np.ndarray:
    """Farthest point of a body along directions in its bind state, from its centre. [D, 3] -> [D]"""
    return (towards @ (body.solid.vertices - body.solid.center).T).max(axis=1)
