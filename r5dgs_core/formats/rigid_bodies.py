"""Hulls of a scene as rigid bodies with their state at a time, for simulators; shared by `hulls`, `mjcf` and `urdf`."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from .. import errors
from ..motion import models, rotations
from ..playback import object_poses
from ..scene import cameras
from ..scene import gravity as gravities
from ..scene.hull import Hull
from ..scene.scene import MotionGroup, Scene
from ..shapes import object_hulls, solid
from ..shapes.solid import Solid
from . import ground, registry, scene_nodes

WORLD, GROUND = "world", "ground"  # names that the files use; MuJoCo reserves the former
DENSITY = 1000.0  # unknown; masses of bodies are proportional to their volumes
FRICTION = 0.3  # of bodies whose friction is unknown
_UNIT = 1e-3  # largest difference of the length of a normal from 1
_NEAR = 0.2  # of the size: distance up to which the centre of rotation in flight replaces the centre of the hull


@dataclass(frozen=True)
class Contacts:
    """Ground of a body and MuJoCo's numbers of its contacts, as they were simulated, in the units of a file, z up.

    Attributes:
        normal: Upward unit normal of the ground. [3]
        height: Height of the ground along the normal.
        solref: Minus stiffness and minus damping.
        solreffriction: The same of friction.
        timestep: Time step.
        flat_foot: True if the lowest part of the body was pressed flat, as it rested at t_max.
    """

    normal: np.ndarray
    height: float
    solref: tuple[float, float]
    solreffriction: tuple[float, float]
    timestep: float
    flat_foot: bool


@dataclass(frozen=True)
class RigidBody:
    """A hull in the units of a file, z up. Its frame has its origin at the centre of mass.

    Attributes:
        name: Unique name.
        solid: The hull in the body's frame.
        position: Centre of mass. [3]
        quat: Rotation from the body's frame to the world, unit wxyz. [4]
        velocity: Of the centre of mass. [3]
        spin: Angular velocity, world axes. [3]
        moves: False for an object without motion of its own, and for one that never moves nor stands on the ground.
        friction: Coulomb coefficient of its contacts, `FRICTION` if it is unknown.
        restitution: Speed after an impact over the speed before it, or None if it is unknown.
        contacts: Ground and contacts of the simulation of its motion, or None if it was not simulated.
    """

    name: str
    solid: Solid
    position: np.ndarray
    quat: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray
    moves: bool
    friction: float = FRICTION
    restitution: float | None = None
    contacts: Contacts | None = None

    @property
    def mass(self) -> float:
        """Mass at the assumed density."""
        return DENSITY * self.solid.volume

    @property
    def inertia(self) -> np.ndarray:
        """Inertia about the centre of mass, in the body's frame. [3, 3]"""
        return DENSITY * self.solid.inertia


def of(scene: Scene, t: float, options: registry.Options, as_simulated: bool = False) -> list[RigidBody]:
    """Return the bodies of the selected objects at a scene time, in metres and seconds if the scene stores these units.

    Args:
        scene: The scene.
        t: The time.
        options: Selection of the objects.
        as_simulated: True for the contacts of simulated bodies and, from t_max on, their shapes and states in the
            simulation; False for those of playback.

    Raises:
        ConfigError: No selected object has a hull.
    """
    wanted = options.object_ids
    chosen = _solids(hull for hull in _hulls(scene) if wanted is None or hull.object_id in wanted)
    if not chosen:
        expected = "expected objects with enough Gaussians for a hull"
        raise errors.ConfigError(f"{scene.name}: {expected}, found none in the selection")
    names = _names(scene, [hull for hull, _ in chosen])
    steady = dataclasses.replace(scene, groups=tuple(_without_offset(group) for group in scene.groups))
    poses = {(one.object_id, one.group): one for one in object_poses.at(steady, (t,))}
    start = {(one.object_id, one.group): one for one in object_poses.at(scene, (t,))}
    turn = cameras.WORLD_TO_BLENDER[scene.world_convention]
    axes, length, time = rotations.rotmats_to_quats(turn), scene.units.meters_per_unit or 1.0, _time_unit(scene)
    found, own, simulated = [], materials(scene), _simulated(scene, t) if as_simulated else {}
    floor = _ground_height(scene)
    for (hull, body), name in zip(chosen, names, strict=True):
        group, contacts = scene.groups[hull.motion_id], simulated.get(hull.object_id)
        if contacts is not None and contacts.flat_foot:
            body = solid.of(solid.with_flat_foot(body.vertices, turn.T @ contacts.normal)[0])
        center = _center_of_mass(group, body, turn[2])
        pose, rates = (one.get((hull.object_id, hull.motion_id)) for one in (start, poses))
        position, quat, velocity, spin = center, rotations.identity(), np.zeros(3), np.zeros(3)
        if pose is not None and rates is not None and hull.motion_id > 0:
            quat = pose.quats[0]
            arm = rotations.rotate(quat, center - group.home)
            spin = rates.angular_velocities[0]
            position, velocity = pose.positions[0] + arm, rates.velocities[0] + np.cross(spin, arm)
        if contacts is not None and t >= scene.t_max:
            position, quat, velocity, spin = _simulated_state(group, center, t - scene.t_max)
        local = solid.of(length * (body.vertices - center) @ turn.T)
        found.append(
            RigidBody(
                name,
                dataclasses.replace(local, center=np.zeros(3)),
                length * turn @ position,
                rotations.multiply(rotations.multiply(axes, quat), rotations.conjugate(axes)),
                length / time * turn @ velocity,
                turn @ spin / time,
                contacts is not None or not _is_fixed(group, scene.tracks.poses[group.id], body, turn[2], floor),
                *own.get(hull.object_id, (FRICTION, None)),
                contacts,
            )
        )
    return found


def gravity(scene: Scene) -> np.ndarray:
    """Gravity in the units of a file, z up; 0 if it is unknown. [3]"""
    found = gravities.of(scene)
    if found is None:
        return np.zeros(3)
    turn = cameras.WORLD_TO_BLENDER[scene.world_convention]
    return turn @ found * (scene.units.meters_per_unit or 1.0) / _time_unit(scene) ** 2


def ground_height(scene: Scene) -> float | None:
    """Height of the plane under the bodies in the units of a file, z up, or None; see `ground.height`."""
    found = _ground_height(scene)
    return None if found is None else found * (scene.units.meters_per_unit or 1.0)


def _ground_height(scene: Scene) -> float | None:
    return ground.height(scene, [hull for hull, _ in _solids(_hulls(scene))])


def _is_fixed(group: MotionGroup, poses: np.ndarray, body: Solid, up: np.ndarray, floor: float | None) -> bool:
    """Return True for a body of the background, and for one that never moves and does not stand on the ground.

    Simulations of contacts fix these bodies, too.

    Args:
        group: Motion group of the body.
        poses: Its observed poses. [S, 7]
        body: Its shape.
        up: Upward unit vector. [3]
        floor: Height of the ground along it, or None.
    """
    if not group.id:
        return True
    carried = group.parent is not None or group.follows is not None or group.joint is not None
    if carried or group.model.kind != "static" or poses[:, 1:].any():
        return False
    return floor is None or abs(float((body.vertices @ up).min()) - floor) > solid.STANDS * body.size


def time_step(scene: Scene) -> float:
    """Step of a simulation: a thousandth of the observed span, in the unit of time of a file."""
    return _time_unit(scene) * (float(np.ptp(scene.tracks.times)) or 1.0) / 1000


def losses(scene: Scene, options: registry.Options) -> list[str]:
    """Parts of this scene that rigid bodies do not hold, as sentences."""
    found, hulls, ids = [], _hulls(scene), options.object_ids
    present = {(hull.object_id, hull.motion_id) for hull in hulls}
    sound = {(hull.object_id, hull.motion_id) for hull, _ in _solids(hulls)}
    lacks = {"without a hull": object_hulls.bodies(scene) - present, "with a flat hull": present - sound}
    for lack, pairs in lacks.items():
        numbers = sorted({pair[0] for pair in pairs if ids is None or pair[0] in ids})
        names = [scene.object(number).name for number in numbers]
        found += [f"objects {lack}: {', '.join(names)}"] if names else []
    if any(group.joint is not None and (ids is None or group.object_id in ids) for group in scene.groups):
        found.append("joints: parts are bodies of their own")
    return found + scene_nodes.lost_bending(scene, ids)


def simulator_losses(scene: Scene, options: registry.Options) -> list[str]:
    """As `losses`, for formats of simulators."""
    unknown = [] if gravity(scene).any() else ["gravity is unknown and set to 0; set it in the simulator"]
    return [*losses(scene, options), *unknown, ground.MISSING if ground_height(scene) is None else ground.LOSS]


def materials(scene: Scene) -> dict[int, tuple[float, float | None]]:
    """Friction and restitution that contacts were simulated with, by id of the object."""
    found: dict[int, tuple[float, float | None]] = {}
    for row in scene.needs:
        number = row.get("object_id")
        if row.get("name") == "contact" and isinstance(number, int) and _is_known(row.get("friction")):
            e = row.get("restitution")
            found[number] = max(row["friction"], 0.0), e if _is_known(e) else None
    return found


def _is_known(value: object) -> bool:
    return isinstance(value, float) and math.isfinite(value)


def _simulated(scene: Scene, t: float) -> dict[int, Contacts]:
    """Ground and contacts of the simulated bodies, by id of the object.

    Before t_max, bodies whose foot was pressed flat for the simulation have the shape, and so the ground, of others.
    """
    turn = cameras.WORLD_TO_BLENDER[scene.world_convention]
    length, time, found = scene.units.meters_per_unit or 1.0, _time_unit(scene), {}
    for row in scene.needs:
        number, own = row.get("object_id"), row.get("simulation")
        if row.get("name") == "contact" and isinstance(number, int) and isinstance(own, dict):
            if t < scene.t_max and own.get("flat_foot"):
                continue
            contacts = None
            with contextlib.suppress(KeyError, TypeError, ValueError, OverflowError):  # needs are free JSON objects
                contacts = Contacts(
                    normal=turn @ np.array(own["normal"], np.float64).reshape(3),
                    height=length * float(own["height"]),
                    solref=_scaled(own["solref"], time),
                    solreffriction=_scaled(own["solreffriction"], time),
                    timestep=time * float(own["timestep"]),
                    flat_foot=bool(own["flat_foot"]),
                )
            if contacts is not None and _is_sound(contacts):
                found[number] = contacts
    return found


def _is_sound(contacts: Contacts) -> bool:
    """Return True if MuJoCo can simulate contacts with these numbers."""
    references = contacts.solref, contacts.solreffriction
    finite = np.isfinite([*contacts.normal, contacts.height, contacts.timestep, *np.ravel(references)]).all()
    unit = abs(float(np.linalg.norm(contacts.normal)) - 1) < _UNIT
    springs = all(stiffness < 0 and damping <= 0 for stiffness, damping in references)
    return bool(finite) and unit and springs and contacts.timestep > 0


def _scaled(reference: Sequence[float], time: float) -> tuple[float, float]:
    """Minus stiffness and minus damping in another unit of time."""
    stiffness, damping = reference
    return stiffness / time**2, damping / time


def _hulls(scene: Scene) -> tuple[Hull, ...]:
    return scene.hulls or object_hulls.of(scene)


def _solids(hulls: Iterable[Hull]) -> list[tuple[Hull, Solid]]:
    """Hulls with their solids, without flat ones."""
    found = []
    for hull in hulls:
        with contextlib.suppress(errors.ConfigError):
            found.append((hull, solid.of(hull.vertices)))
    return found


def _time_unit(scene: Scene) -> float:
    return scene.units.seconds_per_unit or 1.0


def _without_offset(group: MotionGroup) -> MotionGroup:
    """Group whose motion past t_max starts on its fitted curve: offsets fade, and are no motion of a free body."""
    model = dataclasses.replace(group.model, offset_rotvec=np.zeros(3), offset_displacement=np.zeros(3))
    return dataclasses.replace(group, model=model)


def _simulated_state(
    group: MotionGroup, center: np.ndarray, tau: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Position, rotation, velocity and spin of a simulated body; in playback, it moves there from its last pose."""
    model = group.model
    quat, moved, spin, velocity = models.curve(model, tau)
    quat = rotations.multiply(quat, rotations.rotvecs_to_quats(model.offset_rotvec))
    arm = rotations.rotate(quat, center - group.pivot)
    return group.pivot + moved + model.offset_displacement + arm, quat, velocity + np.cross(spin, arm), spin


def _center_of_mass(group: MotionGroup, body: Solid, up: np.ndarray) -> np.ndarray:
    """Centre of the hull; of a body in flight, the point about which it spins, which the motion determines better. [3]

    Motions with contacts were simulated about the centre of the hull.
    """
    point = group.pivot + group.model.center_offset
    flies = gravities.falls(group.model, up)
    return point if flies and np.linalg.norm(point - body.center) < _NEAR * body.size else body.center


def _names(scene: Scene, hulls: list[Hull]) -> list[str]:
    groups, used = scene_nodes.group_names(scene), {WORLD, GROUND}
    return [
        unused(groups[hull.motion_id] if hull.motion_id else scene.object(hull.object_id).name, used) for hull in hulls
    ]


def unused(name: str, used: set[str]) -> str:
    """Return a name with a number if it is used already, and add it to the used ones."""
    found, count = name, 1
    while found in used:
        count += 1
        found = f"{name} {count}"
    used.add(found)
    return found
