"""Time for which simulated bodies fly free, by bounding balls.

Between contacts, bodies fall with constant acceleration and turn without torque, so that few long steps replace the
short ones that contacts need.
"""

from __future__ import annotations

import math

import numpy as np

from .world import Body, World

ROUND = 1e-3  # relative difference of the moments of inertia of a body that spins at a constant rate
_ROOM = 1e-6  # by which bounding balls are larger than bodies, relatively


class Flights:
    """Bounds of the bodies of a world.

    Args:
        world: The world.
        unit: World units per unit of length of positions and rates.
    """

    def __init__(self, world: World, unit: float):
        moving, fixed = ([b for b in world.bodies if b.fixed == still] for still in (False, True))
        self._radii = [_radius(body) / unit for body in moving]
        self._obstacles = [(*(body.solid.center / unit).tolist(), _radius(body) / unit) for body in fixed]
        self._gravity = float(np.linalg.norm(world.gravity)) / unit
        self._plane: tuple[float, ...] = (0.0, 0.0, 1.0)
        self._floors, self._pull = [-math.inf] * len(moving), 0.0
        if world.plane is not None:
            plane = world.plane
            self._plane = tuple(plane.normal.tolist())
            self._floors = [(plane.height if b.floor is None else b.floor) / unit for b in moving]
            self._pull = float(plane.normal @ world.gravity) / unit

    def time(self, positions: list[float], rates: list[float]) -> float:
        """Time up to which no bounding ball touches anything; 0 if one does now.

        Args:
            positions: Place and quaternion of each moving body. [7 M]
            rates: Velocity and spin of each. [6 M]
        """
        places = [tuple(positions[7 * k : 7 * k + 3]) for k in range(len(self._radii))]
        velocities = [tuple(rates[6 * k : 6 * k + 3]) for k in range(len(self._radii))]
        found = math.inf
        for place, velocity, radius, floor in zip(places, velocities, self._radii, self._floors, strict=True):
            gap = _dot(self._plane, place) - radius - floor
            found = min(found, _fall(gap, _dot(self._plane, velocity), self._pull))
            if not found > 0:
                return 0.0
        for k, (place, velocity, radius) in enumerate(zip(places, velocities, self._radii, strict=True)):
            for x, y, z, other in self._obstacles:
                gap = math.dist(place, (x, y, z)) - radius - other
                found = min(found, _fall(gap, -math.hypot(*velocity), -self._gravity))
            for other in range(k):
                apart = [a - b for a, b in zip(place, places[other], strict=True)]
                speed = [a - b for a, b in zip(velocity, velocities[other], strict=True)]
                found = min(found, _meeting(apart, speed, radius + self._radii[other]))
        return found


def _radius(body: Body) -> float:
    """Radius of the ball about the centre of mass that holds a body."""
    radius = body.ball_radius
    if radius is None:
        radius = float(np.linalg.norm(body.solid.vertices - body.solid.center, axis=1).max())
    return (1 + _ROOM) * radius


def _dot(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _fall(gap: float, speed: float, pull: float) -> float:
    """First time at which gap + speed t + pull t^2 / 2 is 0; 0 if the gap is not positive."""
    if not gap > 0:
        return 0.0
    if pull >= 0 and speed >= 0:
        return math.inf
    root = speed * speed - 2 * pull * gap
    if root < 0:
        return math.inf
    root = math.sqrt(root)
    return -(speed + root) / pull if speed > 0 else 2 * gap / (root - speed)  # without a difference of equal numbers


def _meeting(apart: list[float], speed: list[float], reach: float) -> float:
    """First time at which two balls in free fall touch, whose centres differ by apart + speed t."""
    gap = sum(a * a for a in apart) - reach * reach
    if not gap > 0:
        return 0.0
    nearing, square = sum(a * b for a, b in zip(apart, speed, strict=True)), sum(b * b for b in speed)
    root = nearing * nearing - square * gap
    return math.inf if nearing >= 0 or root < 0 else gap / (math.sqrt(root) - nearing)
