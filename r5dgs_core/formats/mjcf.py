"""Scenes as MuJoCo models (MJCF): hulls as free bodies, and a keyframe with their poses and velocities."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from .. import atomic_files
from ..motion import rotations
from ..scene.scene import Scene
from . import registry, rigid_bodies
from .rigid_bodies import RigidBody

KEY = "start"  # name of the keyframe
_TORSION = (0.005, 0.0001)  # MuJoCo's torsional and rolling friction


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write the bodies at each time. Implements `registry.Format.write`."""
    height = rigid_bodies.ground_height(scene)
    for t, target in zip(options.times, FORMAT.paths(path, options, scene), strict=True):
        tree = model(scene, rigid_bodies.of(scene, t, options), height)
        ElementTree.indent(tree)
        with registry.writing(target):
            atomic_files.write(target, ElementTree.tostring(tree, "utf-8", xml_declaration=True) + b"\n")
        yield target


def model(scene: Scene, bodies: list[RigidBody], height: float | None) -> ElementTree.Element:
    """Return the element ``mujoco`` of a scene and its bodies, over the ground at a height if there is one."""
    root = ElementTree.Element("mujoco", model=scene.name)
    add = ElementTree.SubElement
    # RK4 is exact for a parabola, and the elliptic cone for friction in any direction.
    option = {"timestep": numbers([rigid_bodies.time_step(scene)]), "integrator": "RK4", "cone": "elliptic"}
    add(root, "option", option, gravity=numbers(rigid_bodies.gravity(scene)))
    defaults = add(root, "default")
    add(defaults, "geom", type="mesh", condim="3", friction=numbers([rigid_bodies.FRICTION, *_TORSION]))
    assets, world = add(root, "asset"), add(root, "worldbody")
    if height is not None:
        # Of two geoms, the larger friction counts: that of the body.
        place = {"pos": numbers([0, 0, height]), "size": "0 0 1", "friction": numbers([0, *_TORSION])}
        add(world, "geom", place, name=rigid_bodies.GROUND, type="plane")
    for body in bodies:
        corners = numbers(body.solid.vertices.ravel())
        add(assets, "mesh", name=body.name, vertex=corners, face=" ".join(map(str, body.solid.triangles.ravel())))
        element = add(world, "body", name=body.name, pos=numbers(body.position), quat=numbers(body.quat))
        if body.moves:
            add(element, "freejoint", name=body.name)
        inertia = numbers(body.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
        add(element, "inertial", pos="0 0 0", mass=numbers([body.mass]), fullinertia=inertia)
        shape = add(element, "geom", name=body.name, mesh=body.name)
        if body.friction != rigid_bodies.FRICTION:
            shape.set("friction", numbers([body.friction, *_TORSION]))
    moving = [body for body in bodies if body.moves]
    if moving:
        places = np.concatenate([[*body.position, *body.quat] for body in moving])
        # MuJoCo has angular velocities of free bodies in their own axes.
        rates = [[*body.velocity, *rotations.rotate(rotations.conjugate(body.quat), body.spin)] for body in moving]
        add(add(root, "keyframe"), "key", name=KEY, qpos=numbers(places), qvel=numbers(np.concatenate(rates)))
    return root


def numbers(values: Iterable[float]) -> str:
    """Numbers as the text of an attribute."""
    return " ".join(f"{value:.12g}" for value in values)


FORMAT = registry.Format(
    name="mjcf",
    label="MuJoCo Model",
    suffix=".xml",
    keeps="convex hulls as rigid bodies with mass, inertia, fitted friction, gravity, ground and a keyframe of poses "
    "and velocities",
    loses="Gaussians, colours, learned motion, restitution, joints, concave shapes, shape of the ground, cameras",
    write=export,
    per_frame=True,
    losses=rigid_bodies.simulator_losses,
    extra="contact",
    packages=("scipy",),
)
