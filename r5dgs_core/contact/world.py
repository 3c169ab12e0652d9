"""Rigid bodies, their materials and the plane that supports them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..motion import restitution as bounces
from ..motion import rotations
from ..shapes.solid import Solid


@dataclass(frozen=True)
class Material:
    """Contact parameters of a body, as they are on the ground and on fixed bodies.

    Attributes:
        friction: Coulomb coefficient, >= 0.
        restitution: Speed after an impact over the speed before it, 0 to 1.
    """

    friction: float = 0.3
    restitution: float = bounces.ASSUMED


NEUTRAL = Material(0.0, 1.0)  # of fixed bodies: a contact with them has the material of the other body


def combined(materials: Sequence[Material]) -> Material:
    """Material of a contact of one body with the ground, or of two: the larger friction, the product of restitutions.

    Source: Blender's Bullet multiplies restitutions. MuJoCo has the larger friction; a product would let bodies slip
        off each other that hold on the ground.
    """
    return Material(max(one.friction for one in materials), math.prod(one.restitution for one in materials))


@dataclass(frozen=True)
class Body:
    """A rigid body in the bind state.

    Attributes:
        solid: Its shape, world units.
        material: Its contact parameters.
        floor: Height of the plane on which it rests, along the normal of the plane; None for the common plane.
        fixed: True if it does not move.
        density: Mass over volume; only ratios count.
    """

    solid: Solid
    material: Material = field(default_factory=Material)
    floor: float | None = None
    fixed: bool = False
    density: float = 1.0

    @property
    def ball_radius(self) -> float | None:
        """Radius of the ball of equal volume if the body is nearly a ball, whose facets would keep it from rolling."""
        return self.solid.ball_radius


@dataclass(frozen=True)
class Plane:
    """Points x with normal . x = height; bodies are on the side to which the unit normal points. [3]"""

    normal: np.ndarray
    height: float


@dataclass(frozen=True)
class Edge:
    """Border of a support, beyond which bodies fall.

    Attributes:
        outline: Corners of the convex support, on its plane. [V, 3]
        ground: The plane below it, or None.
    """

    outline: np.ndarray
    ground: Plane | None


@dataclass(frozen=True)
class World:
    """Bodies and their surroundings.

    Attributes:
        bodies: B bodies.
        plane: The supporting plane, or None.
        gravity: Acceleration of a falling body. [3]
        edge: Border of the plane; None if it has no end.
    """

    bodies: tuple[Body, ...]
    plane: Plane | None
    gravity: np.ndarray
    edge: Edge | None = None


@dataclass(frozen=True)
class State:
    """Poses of B bodies relative to the bind state, and their rates, in the world frame.

    Attributes:
        places: Centres of mass. [B, 3]
        quats: Unit wxyz. [B, 4]
        velocities: Of the centres of mass. [B, 3]
        spins: Angular velocities. [B, 3]
    """

    places: np.ndarray
    quats: np.ndarray
    velocities: np.ndarray
    spins: np.ndarray

    def one(self, body: int) -> State:
        """State of one body alone."""
        rows = slice(body, body + 1)
        return State(self.places[rows], self.quats[rows], self.velocities[rows], self.spins[rows])

    def batch(self) -> State:
        """The state as a batch of one, with a leading dimension for simulations of many states."""
        return State(self.places[None], self.quats[None], self.velocities[None], self.spins[None])


def at_rest(world: World) -> State:
    """State of bodies at rest in the bind state."""
    count = len(world.bodies)
    places = np.array([body.solid.center for body in world.bodies]).reshape(count, 3)
    return State(places, rotations.identity(count), np.zeros((count, 3)), np.zeros((count, 3)))


def gaps(body: Body, plane: Plane, places: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """Height of the lowest point of a body over its plane in given poses. [..., 3], [..., 4] -> [...]"""
    floor = plane.height if body.floor is None else body.floor
    radius = body.ball_radius
    if radius is not None:
        return places @ plane.normal - radius - floor
    arms = body.solid.vertices - body.solid.center
    down = rotations.rotate(rotations.conjugate(quats), np.broadcast_to(plane.normal, places.shape))
    return places @ plane.normal + (down @ arms.T).min(axis=-1) - floor
