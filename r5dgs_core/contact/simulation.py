"""Simulation of a world by MuJoCo, from any state and with any materials.

MuJoCo's friction cone is elliptic, as the pyramidal one is wrong by 41 % in diagonal directions; its matrices are
dense, as these are faster for few bodies; speculative contacts keep thin bodies from passing through each other.
Its unit of length is the size of the largest body, because MuJoCo has smallest and largest values. While no body can
touch anything, few steps of Runge and Kutta replace the steps that contacts need.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from .. import errors, extras
from ..motion import restitution, rotations
from . import world as worlds
from .flights import ROUND, Flights
from .stepping import Stepping
from .world import Body, Material, State, World

log = logging.getLogger(__name__)
_SOFT, _STIFF = 0.99, 0.9999  # impedances; MuJoCo has none beyond the latter
_YIELD = 10.0  # times 1 / (mass ratio): 1 - impedance; under a heavy body, a light one sinks by the product of the two
_LEAST_FRICTION, _MOST_FRICTION = 1e-5, 1e3
_TURN = 0.1  # rotation in one step of a flight of a body whose spin is not constant, rad
_CHECKED = 16  # steps between two searches for a flight
_WORTH = 16.0  # least length of a flight, in steps
_BEFORE = 1.3  # steps before a contact at which a flight ends; bounces are the most exact with a third of a step left
_ALONE = {"contype": 0, "conaffinity": 0}  # of geometry that touches nothing but by explicit pairs
_TOUCHING = 1e-3  # penetration that stays in the initial state, as a share of a body's size


class Simulation:
    """A compiled world. Calls are independent of each other.

    Attributes:
        world, stepping: Those given.
        unit: World units per MuJoCo's unit of length.
        model, data, mujoco: MuJoCo's model, state and module.

    Raises:
        BackendError: MuJoCo is not installed.
        ConfigError: MuJoCo refuses a body.
    """

    def __init__(self, world: World, stepping: Stepping):
        with extras.required("contacts", "contact"):
            import mujoco as engine
        mujoco: Any = engine
        mujoco.set_mju_user_warning(log.debug)  # it would write MUJOCO_LOG.TXT into the working directory
        self.mujoco = mujoco
        self.world, self.stepping = world, stepping
        self.unit = max((body.solid.size for body in world.bodies), default=1.0)
        spec = _specification(mujoco, world, stepping, self.unit)
        try:
            self.model = spec.compile()
        except ValueError as error:
            raise errors.ConfigError(f"contacts: MuJoCo refuses the bodies: {error}") from error
        self.data = mujoco.MjData(self.model)
        self._moving = [i for i, body in enumerate(world.bodies) if not body.fixed]
        self._geoms = np.array([self.model.geom(f"body{i}").id for i in range(len(world.bodies))], int)
        self._numbers = np.full(self.model.ngeom, -1)
        self._numbers[self._geoms] = range(len(self._geoms))
        pairs = self._numbers[np.stack([self.model.pair_geom1, self.model.pair_geom2], axis=1)]
        self._pairs = [[i for i in sorted(pair) if i >= 0] for pair in pairs.tolist()]
        self._flights = Flights(world, self.unit)
        moments = self.model.body_inertia[self.model.dof_bodyid[::6]]
        self._steady = bool((np.ptp(moments, axis=1) <= ROUND * moments.max(axis=1)).all())
        self.set_materials([body.material for body in world.bodies])

    def set_materials(self, materials: Sequence[Material]) -> None:
        """Set the materials of the B bodies."""
        model, frequency, least = self.model, self.stepping.frequency, self.stepping.least_restitution
        for pair, bodies in enumerate(self._pairs):
            shared = worlds.combined([materials[i] for i in bodies])
            reference = restitution.reference(max(shared.restitution, least), frequency)
            model.pair_friction[pair, :2] = min(max(shared.friction, _LEAST_FRICTION), _MOST_FRICTION)
            model.pair_solref[pair] = reference
            model.pair_solreffriction[pair] = restitution.grip(reference)

    def load(self, state: State) -> None:
        """Set the state at time 0."""
        positions, rates = self._packed(state)
        self._reset(positions, rates)

    def _reset(self, positions: np.ndarray, rates: np.ndarray) -> None:
        self.mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = positions, rates

    def _packed(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """MuJoCo's positions [..., 7 M] and rates [..., 6 M] of a state; inverse of `_unpacked`."""
        shape = (*state.places.shape[:-2], -1)
        places, quats, velocities, spins = (
            values[..., self._moving, :] for values in (state.places, state.quats, state.velocities, state.spins)
        )
        own_spins = rotations.rotate(rotations.conjugate(quats), spins)
        positions = np.concatenate([places / self.unit, quats], axis=-1)
        return positions.reshape(shape), np.concatenate([velocities / self.unit, own_spins], axis=-1).reshape(shape)

    def state(self) -> State:
        """Present state; fixed bodies are at rest."""
        return self._unpacked(self.data.qpos, self.data.qvel)

    def _unpacked(self, positions: np.ndarray, rates: np.ndarray) -> State:
        """State from MuJoCo's positions [..., 7 M] and rates [..., 6 M] of the M bodies that are not fixed."""
        shape = (*positions.shape[:-1], len(self.world.bodies))
        places, quats = np.empty((*shape, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (*shape, 1))
        velocities, spins = np.zeros((*shape, 3)), np.zeros((*shape, 3))
        places[:] = np.array([body.solid.center for body in self.world.bodies]).reshape(-1, 3)
        positions, rates = positions.reshape(*shape[:-1], -1, 7), rates.reshape(*shape[:-1], -1, 6)
        places[..., self._moving, :], quats[..., self._moving, :] = self.unit * positions[..., :3], positions[..., 3:]
        velocities[..., self._moving, :] = self.unit * rates[..., :3]
        spins[..., self._moving, :] = rotations.rotate(positions[..., 3:], rates[..., 3:])
        return State(places, quats, velocities, spins)

    def advance(self, time: float) -> None:
        """Simulate up to a time in free flight, or up to the last step before it."""
        model, data, step = self.model, self.data, self.stepping.step
        while (steps := int(np.floor((time - data.time) / step + 1e-9))) > 0:
            free = self._flights.time(data.qpos.tolist(), data.qvel.tolist()) - _BEFORE * step if model.nv else 0.0
            if free > _WORTH * step:
                self._fly(min(free, time - data.time))
            else:
                self.mujoco.mj_step(model, data, min(steps, _CHECKED) if model.nv else steps)

    def _fly(self, span: float) -> None:
        """Simulate bodies that touch nothing for a time."""
        option, spins = self.model.opt, self.data.qvel.reshape(-1, 6)[:, 3:]
        steps = 1
        if not self._steady:
            steps = max(
                math.ceil(min(span / option.timestep, span * float(np.abs(spins).sum(axis=1).max()) / _TURN)), 1
            )
        kept = option.timestep, option.integrator, option.disableflags
        option.timestep, option.integrator = span / steps, int(self.mujoco.mjtIntegrator.mjINT_RK4)
        option.disableflags = kept[2] | int(self.mujoco.mjtDisableBit.mjDSBL_CONTACT)
        try:
            self.mujoco.mj_step(self.model, self.data, steps)
        finally:
            option.timestep, option.integrator, option.disableflags = kept

    def state_at(self, time: float) -> State:
        """Simulate up to a time, the rest after the last whole step at constant rates, and return the state there."""
        self.advance(time)
        now = self.state()
        quats, places = _moved(now, time - self.data.time)
        return State(places, quats, now.velocities, now.spins)

    @property
    def failed(self) -> bool:
        """True if MuJoCo has reset the state because of a number that is not finite or huge."""
        kinds = self.mujoco.mjtWarning
        bad = (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)
        return any(self.data.warning[kind].number for kind in bad)

    def poses(self, state: State, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Simulate from a state at time 0.

        Args:
            state: The initial state.
            times: Times >= 0, increasing. [T]

        Returns:
            Quaternions relative to the bind state [T, B, 4] and centres of mass [T, B, 3]; not a number after a
            simulation has failed.
        """
        one = State(*(values[None] for values in (state.places, state.quats, state.velocities, state.spins)))
        quats, places = self.paths(one, times)
        return quats[0], places[0]

    def paths(
        self, states: State, times: np.ndarray, materials: Sequence[Sequence[Material]] = ()
    ) -> tuple[np.ndarray, np.ndarray]:
        """Simulate from many states, as `poses` does.

        Args:
            states: N initial states, with a leading axis.
            times: Times >= 0, increasing. [T]
            materials: Materials of the bodies in each simulation; empty to keep the present ones.

        Returns:
            Quaternions [N, T, B, 4] and centres of mass [N, T, B, 3].
        """
        starts, speeds = self._packed(states)
        shape = (len(starts), len(times))
        positions, rates = np.empty((*shape, self.model.nq)), np.empty((*shape, self.model.nv))
        rest, failed = np.empty(shape), np.zeros(len(starts), bool)
        for n, (start, speed) in enumerate(zip(starts, speeds, strict=True)):
            if materials:
                self.set_materials(materials[n])
            self._reset(start, speed)
            for row, time in enumerate(times.tolist()):
                self.advance(time)
                positions[n, row], rates[n, row], rest[n, row] = self.data.qpos, self.data.qvel, time - self.data.time
            failed[n] = self.failed
        quats, places = _moved(self._unpacked(positions, rates), rest[..., None, None])
        places[failed], quats[failed] = np.nan, np.nan
        return quats, places

    def contacts(self) -> dict[tuple[int, int], float]:
        """Normal forces that push now, by the two bodies, -1 for the plane."""
        present = self.data.contact
        pushing = np.flatnonzero(present.efc_address >= 0)
        forces = self.data.efc_force[present.efc_address[pushing]]  # of an elliptic cone, the first is normal
        pairs = np.sort(self._numbers[present.geom[pushing]], axis=1)
        found: dict[tuple[int, int], float] = {}
        for (first, second), force in zip(pairs.tolist(), forces.tolist(), strict=True):
            if force > 0:
                found[first, second] = found.get((first, second), 0.0) + force
        return found

    def deepest(self, state: State) -> dict[tuple[int, int], float]:
        """Penetrations of a state that are more than a thousandth of the smaller body, by the two bodies."""
        self.load(state)
        self.mujoco.mj_forward(self.model, self.data)
        found: dict[tuple[int, int], float] = {}
        for contact in self.data.contact[: self.data.ncon]:
            pair = self._pair(contact)
            size = min(self.world.bodies[i].solid.size for i in pair if i >= 0)
            depth = -self.unit * float(contact.dist)
            if depth > _TOUCHING * size:
                found[pair] = max(found.get(pair, 0.0), depth)
        return found

    def _pair(self, contact: Any) -> tuple[int, int]:
        first, second = sorted(self._numbers[contact.geom].tolist())
        return first, second


def _moved(now: State, rest: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and places after a time at constant rates. [..., B, 4], [..., B, 3]"""
    quats = rotations.multiply(rotations.rotvecs_to_quats(rest * now.spins), now.quats)
    return quats, now.places + rest * now.velocities


def _specification(mujoco: Any, world: World, stepping: Stepping, unit: float) -> Any:
    """Model of a world before it is compiled: an `MjSpec`, with lengths in a unit and masses in that of the largest.

    All contacts are those of explicit pairs, as only these have a damping of friction of their own.
    """
    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep, option.gravity = stepping.step, world.gravity / unit
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.enableflags = int(mujoco.mjtEnableBit.mjENBL_SPECULATIVE)
    masses = [body.density * body.solid.volume for body in world.bodies if not body.fixed] or [1.0]
    heaviest, impedance = max(masses), _impedance(max(masses) / min(masses))
    shared = {"condim": 3, "solimp": impedance}
    for i, body in enumerate(world.bodies):
        _add_body(mujoco, spec, i, body, unit, body.density * unit**3 / heaviest)
        for j, other in enumerate(world.bodies[:i]):
            if not (body.fixed and other.fixed):
                spec.add_pair(geomname1=f"body{j}", geomname2=f"body{i}", **shared)
        if world.plane is not None and not body.fixed:
            _add_floor(mujoco, spec, i, body, world, unit, impedance)
    return spec


def _add_body(mujoco: Any, spec: Any, number: int, body: Body, unit: float, density: float) -> None:
    solid, name, radius = body.solid, f"body{number}", body.ball_radius
    added = spec.worldbody.add_body(name=name, pos=solid.center / unit)
    if not body.fixed:
        added.add_freejoint()
    if radius is not None:
        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
        added.add_geom(name=name, type=sphere, size=[radius / unit, 0, 0], density=density, **_ALONE)
        return
    mesh = spec.add_mesh(name=name)
    mesh.uservert, mesh.userface = ((solid.vertices - solid.center) / unit).ravel(), solid.triangles.ravel()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    added.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, density=density, **_ALONE)


def _impedance(mass_ratio: float) -> list[float]:
    """MuJoCo's ``solimp`` for a mass ratio >= 1: constant, so that solref alone determines the restitution."""
    found = min(max(1 - _YIELD / mass_ratio, _SOFT), _STIFF)
    return [found, found, 0.001, 0.5, 2]


def _add_floor(
    mujoco: Any, spec: Any, number: int, body: Body, world: World, unit: float, impedance: list[float]
) -> None:
    """Add what a body rests on, which touches that body alone: a plane, or a prism over the ground."""
    assert world.plane is not None
    normal, height = world.plane.normal, world.plane.height if body.floor is None else body.floor
    levels = [(f"floor{number}", world.plane, height)]
    if world.edge is not None:
        ground = world.edge.ground
        levels = [] if ground is None else [(f"ground{number}", ground, ground.height)]
        top = world.edge.outline + (height - world.edge.outline @ normal)[:, None] * normal
        depth = body.solid.size if ground is None else max(world.plane.height - ground.height, 0.1 * body.solid.size)
        mesh = spec.add_mesh(name=f"floor{number}")
        mesh.uservert = (np.concatenate([top, top - depth * normal]) / unit).ravel()
        spec.worldbody.add_geom(
            name=f"floor{number}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"floor{number}", **_ALONE
        )
        spec.add_pair(geomname1=f"floor{number}", geomname2=f"body{number}", condim=3, solimp=impedance)
    for name, plane, level in levels:
        spec.worldbody.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0, 0, 0.05],
            pos=level / unit * plane.normal,
            quat=rotations.between_vectors(np.array([0.0, 0.0, 1.0]), plane.normal),
            **_ALONE,
        )
        spec.add_pair(geomname1=name, geomname2=f"body{number}", condim=3, solimp=impedance)
