"""Bodies for tests of contacts."""

from __future__ import annotations

import itertools

import numpy as np

from r5dgs_core.contact import simulation, stepping, world
from r5dgs_core.shapes import directions, solid

G = 9.81
SIZE = 0.1


def box(center, sides=(SIZE, SIZE, SIZE), friction=0.3, restitution=0.3, **options):
    corners = 0.5 * np.array(list(itertools.product(*[(-s, s) for s in sides])))
    return world.Body(solid.of(corners + center), world.Material(friction, restitution), **options)


def ball(center, friction=0.3, restitution=0.3, **options):
    points = 0.5 * SIZE * directions.sphere(100)
    return world.Body(solid.of(points + center), world.Material(friction, restitution), **options)


def on_plane(*bodies, slope=0.0, height=0.0):
    """World whose plane is inclined about the y axis: gravity is turned instead."""
    gravity = G * np.array([np.sin(slope), 0, -np.cos(slope)])
    return world.World(bodies, world.Plane(np.array([0.0, 0.0, 1.0]), height), gravity)


def simulate(place, speed=2.0, duration=1.0, draft=False):
    """Simulation with the steps that the rule chooses, and the state at rest."""
    size = min(body.solid.size for body in place.bodies)
    chosen = stepping.choose(speed, size, float(np.linalg.norm(place.gravity)), duration, draft)
    return simulation.Simulation(place, chosen), world.at_rest(place)
