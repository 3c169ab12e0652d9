"""Scenes as MuJoCo models (MJCF): hulls as free bodies, and a keyframe with their poses and velocities."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from .. import atomic_files
from ..motion import restitution, rotations
from ..scene.scene import Scene
from . import registry, rigid_bodies
from .rigid_bodies import RigidBody

KEY = "start"  # name of the keyframe
_TORSION = (0.005, 0.0001)  # MuJoCo's torsional and rolling friction
_TOGETHER, _ON_GROUND = 1, 2  # bits of the contacts between bodies, and of those with the common ground
_IMPEDANCE = (0.99, 0.99, 0.001, 0.5, 2.0)  # constant, so that solref alone determines the restitution


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write the bodies at each time. Implements `registry.Format.write`."""
    height = rigid_bodies.ground_height(scene)
    for t, target in zip(options.times, FORMAT.paths(path, options, scene), strict=True):
        tree = model(scene, rigid_bodies.of(scene, t, options, as_simulated=True), height)
        ElementTree.indent(tree)
        with registry.writing(target):
            atomic_files.write(target, ElementTree.tostring(tree, "utf-8", xml_declaration=True) + b"\n")
        yield target


def model(scene: Scene, bodies: list[RigidBody], height: float | None) -> ElementTree.Element:
    """Return the element ``mujoco`` of a scene and its bodies, over the ground at a height if there is one."""
    root = ElementTree.Element("mujoco", model=scene.name)
    add = ElementTree.SubElement
    simulated = [body.contacts for body in bodies if body.contacts is not None]
    # RK4 is exact for a parabola, and the elliptic cone for friction in any direction.
    option = {"timestep": numbers([rigid_bodies.time_step(scene)]), "integrator": "RK4", "cone": "elliptic"}
    if simulated:  # as the scene's motions were simulated
        step = min(one.timestep for one in simulated)
        option |= {"timestep": numbers([step]), "integrator": "Euler", "jacobian": "dense"}
    add(root, "option", option, gravity=numbers(rigid_bodies.gravity(scene)))
    defaults = add(root, "default")
    add(defaults, "geom", type="mesh", condim="3", friction=numbers([rigid_bodies.FRICTION, *_TORSION]))
    assets, world = add(root, "asset"), add(root, "worldbody")
    if height is not None:
        # Of two geoms, the larger friction counts: that of the body.
        place = {"pos": numbers([0, 0, height]), "size": "0 0 1", "friction": numbers([0, *_TORSION])}
        affinity = {"contype": "0", "conaffinity": str(_ON_GROUND)} if simulated else {}
        add(world, "geom", place | affinity, name=rigid_bodies.GROUND, type="plane")
    for body in bodies:
        shape = _add_body(assets, world, body)
        if simulated and body.contacts is None:
            shape.set("contype", str(_TOGETHER | _ON_GROUND))
    if simulated:
        _add_contacts(root, world, bodies)
    moving = [body for body in bodies if body.moves]
    if moving:
        places = np.concatenate([[*body.position, *body.quat] for body in moving])
        # MuJoCo has angular velocities of free bodies in their own axes.
        rates = [[*body.velocity, *rotations.rotate(rotations.conjugate(body.quat), body.spin)] for body in moving]
        add(add(root, "keyframe"), "key", name=KEY, qpos=numbers(places), qvel=numbers(np.concatenate(rates)))
    return root


def _add_body(assets: ElementTree.Element, world: ElementTree.Element, body: RigidBody) -> ElementTree.Element:
    """Add a body and return its geometry: a sphere if it is nearly one, whose facets would keep it from rolling."""
    add, radius, inertia = ElementTree.SubElement, body.solid.ball_radius, body.inertia
    element = add(world, "body", name=body.name, pos=numbers(body.position), quat=numbers(body.quat))
    if body.moves:
        add(element, "freejoint", name=body.name)
    if radius is not None:
        inertia = 0.4 * body.mass * radius**2 * np.eye(3)
    moments = numbers(inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
    add(element, "inertial", pos="0 0 0", mass=numbers([body.mass]), fullinertia=moments)
    if radius is not None:
        shape = add(element, "geom", name=body.name, type="sphere", size=numbers([radius]))
    else:
        corners = numbers(body.solid.vertices.ravel())
        add(assets, "mesh", name=body.name, vertex=corners, face=" ".join(map(str, body.solid.triangles.ravel())))
        shape = add(element, "geom", name=body.name, mesh=body.name)
    if body.friction != rigid_bodies.FRICTION:
        shape.set("friction", numbers([body.friction, *_TORSION]))
    return shape


def _add_contacts(root: ElementTree.Element, world: ElementTree.Element, bodies: list[RigidBody]) -> None:
    """Add the contacts of bodies that were simulated: with a ground of their own each, and with all bodies."""
    add, pairs = ElementTree.SubElement, ElementTree.SubElement(root, "contact")
    simulated = [body for body in bodies if body.contacts is not None]
    others = [body for body in bodies if body.contacts is None]
    used = {rigid_bodies.GROUND, *(body.name for body in bodies)}
    for number, body in enumerate(simulated):
        own = body.contacts
        assert own is not None
        ground = rigid_bodies.unused(f"{rigid_bodies.GROUND} of {body.name}", used)
        place = {"pos": numbers(own.height * own.normal), "zaxis": numbers(own.normal), "size": "0 0 1"}
        add(world, "geom", place, name=ground, type="plane", contype="0", conaffinity="0")
        for name, other in ((ground, body), *((other.name, other) for other in (*simulated[:number], *others))):
            friction = max(body.friction, other.friction if other.moves else 0.0)
            mu = numbers([friction] * 2 + [_TORSION[0]] + [_TORSION[1]] * 2)
            pair = {key: numbers(values) for key, values in _contact(body, other).items()}
            add(pairs, "pair", pair, geom1=name, geom2=body.name, condim="3", friction=mu)


def _contact(body: RigidBody, other: RigidBody) -> dict[str, Iterable[float]]:
    """Numbers of the contact of a simulated body with its ground, if ``other`` is the body itself, or another body.

    As in simulations, restitutions are multiplied, and those of the ground and of fixed bodies are one.
    """
    own = body.contacts
    assert own is not None
    solref, grip = own.solref, own.solreffriction
    if other is not body and other.moves and body.restitution is not None:
        others = restitution.ASSUMED if other.restitution is None else other.restitution
        solref = restitution.reference(body.restitution * others, math.sqrt(-own.solref[0]))
        grip = restitution.grip(solref)
    return {"solref": solref, "solreffriction": grip, "solimp": _IMPEDANCE}


def numbers(values: Iterable[float]) -> str:
    """Numbers as the text of an attribute."""
    return " ".join(f"{value:.12g}" for value in values)


FORMAT = registry.Format(
    name="mjcf",
    label="MuJoCo Model",
    suffix=".xml",
    keeps="convex hulls and balls as rigid bodies with mass, inertia, fitted friction, simulated contacts, gravity, "
    "ground and a keyframe of poses and velocities",
    loses="Gaussians, colours, learned motion, joints, concave shapes, shape of the ground, cameras",
    write=export,
    per_frame=True,
    losses=rigid_bodies.simulator_losses,
    extra="contact",
    packages=("scipy",),
)
