"""World of a scene's bodies: floors, states and materials from their observed poses."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from ..motion import models, restitution
from ..scene import world_axes
from ..scene.scene import Scene
from ..shapes import boxes, solid
from . import edges, floors, futures, held_out, scene_bodies, stepping, support, world
from .held_out import Comparison
from .identify import Estimate, Fitter
from .scene_bodies import SceneBody
from .simulation import Simulation
from .stepping import Stepping
from .world import Body, Material, Plane, State, World

SAMPLES = 32
_LEAST_POSES = 3
_MISFIT = 30.0  # mean squared residual in units of the noise above which contacts do not explain the poses
_CORNERS = 8  # of a box
_ROUNDS = 6  # of shrinking bodies that overlap


@dataclass(frozen=True)
class Wishes:
    """Changes by the user.

    Attributes:
        pushes: Changes of the velocity at t_max by group, world units per unit of time. [3] each
        materials: Friction and restitution by group; None keeps the fitted one.
        ignored: Groups that touch nothing.
        masses: Factors of the mass by group, which is otherwise proportional to the volume.
        gravity: Acceleration of a falling body; None for that of the scene. [3]
        obstacles: Fixed bodies by name: the convex hulls of points [V, 3] in the world.
        until: Scene time up to which to simulate; None for the horizon.
        samples: Number of sampled futures.
        seed: Seed of the samples.
    """

    pushes: Mapping[int, np.ndarray] = field(default_factory=dict)
    materials: Mapping[int, tuple[float | None, float | None]] = field(default_factory=dict)
    ignored: frozenset[int] = frozenset()
    masses: Mapping[int, float] = field(default_factory=dict)
    gravity: np.ndarray | None = None
    obstacles: Mapping[str, np.ndarray] = field(default_factory=dict)
    until: float | None = None
    samples: int = SAMPLES
    seed: int = 0

    def material(self, group: int, fitted: Material) -> Material:
        """Material of a group with the user's values in place of fitted ones."""
        friction, restitution = self.materials.get(group, (None, None))
        return Material(
            fitted.friction if friction is None else friction,
            fitted.restitution if restitution is None else restitution,
        )


@dataclass(frozen=True)
class SceneWorld:
    """Bodies of a scene that may touch each other.

    Attributes:
        bodies: The B bodies.
        world: Their shapes and materials, and the supporting plane.
        fits: Fitter and result of each body whose contacts explain its poses, by number.
        lines: Reasons for which other bodies have none, a sentence each.
        comparisons: Test by held-out poses of those of them that needed one, by number.
    """

    bodies: tuple[SceneBody, ...]
    world: World
    fits: Mapping[int, tuple[Fitter, Estimate]]
    lines: tuple[str, ...]
    comparisons: Mapping[int, Comparison]

    def start(self, t_max: float) -> State:
        """Most likely state at t_max."""
        state = world.at_rest(self.world)
        for number, body in enumerate(self.bodies):
            if number in self.fits:
                _put(state, number, self.fits[number][0].at(self.fits[number][1], t_max))
            elif body.moves:
                _, _, spin, velocity = models.evaluate_with_rates(body.smooth, 0.0)
                state.spins[number] = spin
                state.velocities[number] = velocity + np.cross(spin, state.places[number] - body.group.pivot)
        return state

    def weighted(self, factors: Mapping[int, float]) -> SceneWorld:
        """The same with masses multiplied by factors, by group."""
        pairs = zip(self.bodies, self.world.bodies, strict=True)
        changed = (dataclasses.replace(own, density=factors.get(body.group.id, 1.0)) for body, own in pairs)
        return dataclasses.replace(self, world=dataclasses.replace(self.world, bodies=tuple(changed)))

    def stepping(self, state: State, duration: float, draft: bool = False) -> Stepping:
        """Frequency of contacts and time step for a simulation from a state."""
        sizes = [body.solid.size for body in self.world.bodies]
        return _stepping(self.world, state, duration, min(sizes), draft)

    def sample(
        self, t_max: float, times: np.ndarray, materials: list[Material], wishes: Wishes
    ) -> dict[int, futures.Futures]:
        """Sampled futures of all bodies at times since t_max, by number."""
        runs = self.draft(t_max, float(times[-1]))
        quats = np.empty((len(times), wishes.samples, len(self.bodies), 4))
        places = np.empty((len(times), wishes.samples, len(self.bodies), 3))
        for n, (state, used) in enumerate(self.draws(t_max, materials, wishes)):
            runs.set_materials(used)
            quats[:, n], places[:, n] = runs.poses(state, times)
        good = np.isfinite(places).all(axis=(0, 2, 3))
        rows = range(len(self.bodies))
        return {k: futures.Futures(times, quats[:, good, k], places[:, good, k]) for k in rows}

    def draft(self, t_max: float, duration: float) -> Simulation:
        """Simulation of sampled futures."""
        return Simulation(self.world, self.stepping(self.start(t_max), duration, draft=True))

    def draws(self, t_max: float, materials: list[Material], wishes: Wishes) -> Iterator[tuple[State, list[Material]]]:
        """Sampled states at t_max, after the pushes, and materials."""
        rng, start = np.random.default_rng(wishes.seed), self.start(t_max)
        for number, body in enumerate(self.bodies):
            start.velocities[number] += wishes.pushes.get(body.group.id, np.zeros(3))
        drawn_of = {number: futures.draws(*fit, wishes.samples, rng) for number, fit in self.fits.items()}
        for _ in range(wishes.samples):
            state, used = _copy(start), list(materials)
            for number, (fitter, estimate) in self.fits.items():
                group = self.bodies[number].group.id
                drawn, material = next(drawn_of[number])
                _put(state, number, fitter.at(dataclasses.replace(estimate, state=drawn, material=material), t_max))
                state.velocities[number] += wishes.pushes.get(group, np.zeros(3))
                used[number] = wishes.material(group, material)
            yield state, used

    def fitted(self) -> dict[int, tuple[float, float]]:
        """Friction and restitution without the user's changes, as they are simulated, by group."""
        pairs = zip(self.bodies, self.world.bodies, strict=True)
        return {
            body.group.id: (own.material.friction, restitution.limited(own.material.restitution)) for body, own in pairs
        }

    def text(self, number: int, material: Material) -> str:
        """Material of a body in words, as it is simulated."""
        words = f"friction {material.friction:.2g}, restitution {restitution.limited(material.restitution):.2g}"
        if number not in self.fits:
            return f"{words}, both assumed"
        deviation = float(np.sqrt(self.fits[number][1].covariance[12, 12]))
        return f"{words}, friction known to {100 * np.expm1(deviation):.0f} %"


def plane(scene: Scene, bodies: list[SceneBody], end: float, up: np.ndarray) -> Plane | None:
    """Plane below the observed and predicted places of the bodies that move, or below all if none does."""
    chosen = [body for body in bodies if body.moves] or bodies
    tau = np.linspace(0, max(end - scene.t_max, 0.0), 8)
    points = [np.concatenate([scene_bodies.predicted(b, tau)[1], scene_bodies.track(scene, b).places]) for b in chosen]
    return support.find(scene, up, np.concatenate(points), min(body.solid.size for body in chosen))


def make(
    scene: Scene,
    bodies: list[SceneBody],
    tried: set[int],
    pushed: set[int],
    doubtful: Mapping[int, bool],
    gravity: np.ndarray,
    end: float,
    leave: edges.Leave | None = None,
    sinking: Collection[int] = (),
) -> SceneWorld:
    """Build the world of the bodies whose motion may be simulated.

    Args:
        scene: The scene.
        bodies: Its bodies.
        tried: Numbers of the bodies to fit. They are left out if the fit fails, as driven bodies are.
        pushed: Numbers of those of them that the user pushes; they are kept and not fixed.
        doubtful: Those of them that need a test by held-out poses, by number: True if it is enough that contacts
            explain these poses, False if contacts must predict them better than a smooth law.
        gravity: Acceleration of a falling body. [3]
        end: Scene time up to which to simulate.
        leave: A body that moves off its support, which then has an edge.
        sinking: Those of them whose smooth motion only sinks into the plane. If contacts predict held-out poses worse,
            its slope is an error of the law, so they keep this motion.
    """
    up = world_axes.UP_AXIS[scene.world_convention]
    below, edge = (plane(scene, bodies, end, up), None) if leave is None else (leave.plane, leave.edge)
    lines = [] if below is not None else ["no plane was found under the bodies"]
    kept = [n for n, body in enumerate(bodies) if not (body.moves and body.reason) or n in tried]
    bodies = [_as_box(body) if n in kept else body for n, body in enumerate(bodies)]
    shapes = tuple(_body(scene, bodies[n], below, n in pushed, gravity) for n in kept)
    made = apart(World(shapes, below, gravity))
    chosen, own, fits, comparisons = [], [], {}, {}
    for number, shape in zip(kept, made.bodies, strict=True):
        body = bodies[number]
        if number in tried and body.moves:
            fitter, estimate = _fit(scene, body, shape, below, gravity, end)
            reason, compared = _misfit(estimate), None
            if not reason and number in doubtful:
                compared = held_out.compare(fitter, up)
                enough = compared.good if doubtful[number] else compared.better
                reason = "" if enough else f"contacts are not clearly better: {compared.text()}"
            elif not reason and number in sinking and held_out.is_possible(scene, body):
                test = held_out.compare(fitter, up)
                reason = "" if test.good else f"contacts are worse: {test.text()}"
            if estimate is not None and not reason:
                fits[len(chosen)] = fitter, estimate
                comparisons |= {} if compared is None else {len(chosen): compared}
                shape = dataclasses.replace(shape, material=estimate.material)
            elif number in pushed:
                lines.append(f"{body.name}: is pushed from the state of its smooth motion: {reason}")
            else:
                lines.append(f"{body.name}: keeps its smooth motion: {reason}")
                continue
        chosen.append(body)
        own.append(shape)
    return SceneWorld(tuple(chosen), World(tuple(own), below, gravity, edge), fits, tuple(lines), comparisons)


def _as_box(body: SceneBody) -> SceneBody:
    """The body with the shape of a box if its hull is nearly one; the user's obstacles stay as they are.

    Hulls of this release are boxes already; those of older scene files bulge over the faces.
    """
    vertices = body.solid.vertices
    corners = boxes.of_hull(vertices) if body.group.id and len(vertices) > _CORNERS else None
    return body if corners is None else dataclasses.replace(body, solid=solid.of(corners))


def _misfit(estimate: Estimate | None) -> str:
    """Return the reason for not using an estimate, or ""."""
    if estimate is None:
        return f"fewer than {_LEAST_POSES} poses were seen since it set off"
    return "" if estimate.misfit <= _MISFIT else "contacts do not explain its poses"  # not a number is a misfit too


def _body(scene: Scene, body: SceneBody, below: Plane | None, pushed: bool, gravity: np.ndarray) -> Body:
    """Shape and floor of a body."""
    if below is None:
        return Body(body.solid) if body.moves or pushed else Body(body.solid, world.NEUTRAL, fixed=True)
    own = Body(body.solid)
    if body.moves:
        return dataclasses.replace(own, floor=floors.of(own, below, scene_bodies.track(scene, body), gravity))
    gap = float((body.solid.vertices @ below.normal).min()) - below.height
    stands = abs(gap) <= solid.STANDS * body.solid.size and body.group.id
    if not stands and not pushed:
        return dataclasses.replace(own, material=world.NEUTRAL, fixed=True)
    if not stands and gap > 0:  # it stands on something else
        return own
    points, floor = solid.with_flat_foot(body.solid.vertices, below.normal)
    return Body(solid.of(points), floor=floor)


def apart(made: World) -> World:
    """Shrink bodies that overlap in the bind state, because a simulation would push them apart at speed."""
    runs = Simulation(made, Stepping(100.0, 1e-3))
    for _ in range(_ROUNDS):
        deep = {pair: depth for pair, depth in runs.deepest(world.at_rest(made)).items() if min(pair) >= 0}
        if not deep:
            return made
        bodies = list(made.bodies)
        for pair, depth in deep.items():
            for number in pair:
                size = bodies[number].solid.size
                shape = bodies[number].solid
                factor = max(1 - 0.6 * depth / size, 0.5)
                anchor = shape.center.copy()
                if made.plane is not None:  # the foot stays where it is
                    down = (shape.vertices - anchor) @ made.plane.normal
                    anchor += down.min() * made.plane.normal
                smaller = solid.of(anchor + factor * (shape.vertices - anchor))
                bodies[number] = dataclasses.replace(bodies[number], solid=smaller)
        made = dataclasses.replace(made, bodies=tuple(bodies))
        runs = Simulation(made, Stepping(100.0, 1e-3))
    return made


def _fit(
    scene: Scene, body: SceneBody, shape: Body, below: Plane | None, gravity: np.ndarray, end: float
) -> tuple[Fitter, Estimate | None]:
    """Fit a body alone over the plane; no estimate if it was seen too seldom."""
    alone = World((shape,), below, gravity)
    track = scene_bodies.track(scene, body, shape.solid.center)
    span = end - (track.times[0] if len(track) else end)
    state = world.at_rest(alone)
    if len(track) > 1:
        state.velocities[0] = np.abs(np.diff(track.places, axis=0)).max(axis=0) / np.diff(track.times).min()
    chosen = _stepping(alone, state, span, shape.solid.size, draft=True)
    fitter = Fitter(Simulation(alone, chosen), track)
    return fitter, fitter.run() if len(track) >= _LEAST_POSES else None


def _stepping(made: World, state: State, duration: float, size: float, draft: bool) -> Stepping:
    g = float(np.linalg.norm(made.gravity))
    speed = float(np.linalg.norm(state.velocities, axis=1).max())
    if made.plane is not None:
        ground = made.plane if made.edge is None or made.edge.ground is None else made.edge.ground
        drop = max(float((state.places @ ground.normal).max()) - ground.height, 0.0)
        speed = float(np.hypot(speed, np.sqrt(2 * g * drop)))
    else:
        speed += g * duration
    return stepping.choose(speed, size, g, duration, draft)


def _put(state: State, number: int, one: State) -> None:
    for name in ("places", "quats", "velocities", "spins"):
        getattr(state, name)[number] = getattr(one, name)[0]


def _copy(state: State) -> State:
    return State(*(x.copy() for x in (state.places, state.quats, state.velocities, state.spins)))
