"""Scenes as URDF: hulls as links with floating joints, with an OBJ mesh beside the file for each.

URDF has no velocities. An element ``r5dgs_state`` of each body holds them; other readers skip it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from .. import atomic_files
from ..motion import rotations
from ..scene.scene import Scene
from . import registry, rigid_bodies
from .mjcf import numbers
from .rigid_bodies import RigidBody

_GROUND_SIDE = 100.0  # of the box that is the ground, over the reach of the bodies


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write the meshes, and the bodies at each time. Implements `registry.Format.write`."""
    bodies = rigid_bodies.of(scene, options.times[0], options)
    targets = FORMAT.paths(path, options, scene)
    meshes = targets[: len(bodies)]
    for body, target in zip(bodies, meshes, strict=True):
        with registry.writing(target):
            atomic_files.write(target, _obj(body).encode())
        yield target
    height = rigid_bodies.ground_height(scene)
    for t, target in zip(options.times, targets[len(bodies) :], strict=True):
        tree = _robot(scene, rigid_bodies.of(scene, t, options), [mesh.name for mesh in meshes], height)
        ElementTree.indent(tree)
        with registry.writing(target):
            atomic_files.write(target, ElementTree.tostring(tree, "utf-8", xml_declaration=True) + b"\n")
        yield target


def companions(scene: Scene, options: registry.Options) -> list[str]:
    """Names of the meshes beside the files."""
    return _mesh_names(rigid_bodies.of(scene, options.times[0], options))


def _mesh_names(bodies: list[RigidBody]) -> list[str]:
    return [f"{number}_{re.sub(r'[^A-Za-z0-9]+', '_', body.name)}.obj" for number, body in enumerate(bodies)]


def _robot(scene: Scene, bodies: list[RigidBody], meshes: list[str], height: float | None) -> ElementTree.Element:
    root = ElementTree.Element("robot", name=scene.name)
    add = ElementTree.SubElement
    extension = add(root, "mujoco")
    add(extension, "compiler", discardvisual="true", fusestatic="false")
    add(extension, "option", gravity=numbers(rigid_bodies.gravity(scene)), cone="elliptic", integrator="RK4")
    extension[1].set("timestep", numbers([rigid_bodies.time_step(scene)]))
    world = add(root, "link", name=rigid_bodies.WORLD)
    if height is not None:
        _add_ground(world, bodies, height)
    for body, mesh in zip(bodies, meshes, strict=True):
        link = add(root, "link", name=body.name)
        inertial = add(link, "inertial")
        add(inertial, "mass", value=numbers([body.mass]))
        entries = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
        add(inertial, "inertia", {name: numbers([body.inertia[at]]) for name, at in entries.items()})
        for part in ("visual", "collision"):
            add(add(add(link, part), "geometry"), "mesh", filename=mesh)
        contact = add(link, "contact")  # Bullet reads it
        add(contact, "lateral_friction", value=numbers([body.friction]))
        if body.restitution is not None:
            add(contact, "restitution", value=numbers([body.restitution]))
        joint = add(root, "joint", name=f"{body.name} joint", type="floating" if body.moves else "fixed")
        add(joint, "origin", xyz=numbers(body.position), rpy=numbers(_roll_pitch_yaw(body.quat)))
        add(joint, "parent", link=rigid_bodies.WORLD)
        add(joint, "child", link=body.name)
        if body.moves:
            add(root, "r5dgs_state", link=body.name, linear=numbers(body.velocity), angular=numbers(body.spin))
    return root


def _add_ground(world: ElementTree.Element, bodies: list[RigidBody], height: float) -> None:
    """Add a large box whose upper side is the ground, as URDF has no planes."""
    reach = max(float(np.abs(body.position).max()) + body.solid.size for body in bodies)
    side = _GROUND_SIDE * (reach + abs(height))
    collision = ElementTree.SubElement(world, "collision")
    ElementTree.SubElement(collision, "origin", xyz=numbers([0, 0, height - 0.005 * side]))
    geometry = ElementTree.SubElement(collision, "geometry")
    ElementTree.SubElement(geometry, "box", size=numbers([side, side, 0.01 * side]))


def _roll_pitch_yaw(quat: np.ndarray) -> np.ndarray:
    """Angles of R = Rz(yaw) Ry(pitch) Rx(roll), rad. [4] -> [3]"""
    R = rotations.quats_to_rotmats(quat)
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    if np.hypot(R[0, 0], R[1, 0]) < 1e-9:  # only roll - yaw or roll + yaw is determined
        return np.array([np.arctan2(-R[1, 2], R[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])])


def _obj(body: RigidBody) -> str:
    corners = [f"v {numbers(corner)}\n" for corner in body.solid.vertices]
    faces = [f"f {a} {b} {c}\n" for a, b, c in (body.solid.triangles + 1).tolist()]
    return "".join([f"o {body.name}\n", *corners, *faces])


FORMAT = registry.Format(
    name="urdf",
    label="URDF",
    suffix=".urdf",
    keeps="convex hulls as links with mass, inertia, fitted friction and restitution; poses, velocities, ground; one "
    "file per frame, and one OBJ file per hull beside them",
    loses="Gaussians, colours, learned motion, joints, concave shapes, shape of the ground, cameras",
    write=export,
    per_frame=True,
    companions=companions,
    losses=rigid_bodies.simulator_losses,
    extra="contact",
    packages=("scipy",),
)
