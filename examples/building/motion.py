"""Motion by closed-form laws, keyed at every frame.

Scenes last from t = 0 to t = 1. Laws are smooth over this range, so that the motion after the last observed time
continues the observed motion. Lengths are in scene units, speeds in units per unit of time, angles in degrees.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import bpy
from mathutils import Quaternion, Vector

FRAMES_PER_UNIT = 60
FIRST_FRAME = 1
Law = Callable[[float], tuple[Vector, Quaternion]]
"""Location and rotation of an object at a scene time."""


@dataclass(frozen=True)
class Actor:
    """An object of a scene. Its id is its position in the list of actors, from 1.

    Attributes:
        ob: Blender object whose pose is the object's; its children belong to it.
        law: Motion; None for an object that stands still or only changes its shape.
    """

    ob: bpy.types.Object
    law: Law | None = None


def perform(actors: Sequence[Actor]) -> None:
    """Key the laws of all actors, and number the actors by pass index in their order from 1."""
    for number, actor in enumerate(actors, start=1):
        if actor.law is not None:
            animate(actor.ob, actor.law)
        for part in (actor.ob, *actor.ob.children_recursive):
            part.pass_index = number


def animate(ob: bpy.types.Object, law: Law) -> None:
    """Key the law's pose at every frame of t in [0, 1], with the quaternion sign nearest to the previous frame."""
    ob.rotation_mode = "QUATERNION"
    before = law(0.0)[1]
    for step in range(FRAMES_PER_UNIT + 1):
        place, turn = law(step / FRAMES_PER_UNIT)
        turn.make_compatible(before)
        ob.location, ob.rotation_quaternion, before = place, turn, turn
        ob.keyframe_insert("location", frame=FIRST_FRAME + step)
        ob.keyframe_insert("rotation_quaternion", frame=FIRST_FRAME + step)


def animate_scale(ob: bpy.types.Object, law: Callable[[float], Sequence[float]]) -> None:
    """Key the scale along the object's own axes at every frame of t in [0, 1]."""
    for step in range(FRAMES_PER_UNIT + 1):
        ob.scale = law(step / FRAMES_PER_UNIT)
        ob.keyframe_insert("scale", frame=FIRST_FRAME + step)


def animate_shape(key: bpy.types.ShapeKey, law: Callable[[float], float]) -> None:
    """Key the value of a shape key, from -1 to 1, at every frame of t in [0, 1]."""
    key.slider_min, key.slider_max = -1.0, 1.0
    for step in range(FRAMES_PER_UNIT + 1):
        key.value = law(step / FRAMES_PER_UNIT)
        key.keyframe_insert("value", frame=FIRST_FRAME + step)


# Laws


def drive(center: Sequence[float], radius: float, start_deg: float, speed_deg: float, rate_deg: float) -> Law:
    """Along a circle, heading along it: the angle is start + speed t + rate t^2 / 2, in degrees."""

    def law(t: float) -> tuple[Vector, Quaternion]:
        angle = math.radians(start_deg + speed_deg * t + 0.5 * rate_deg * t * t)
        place = Vector(center) + radius * Vector((math.cos(angle), math.sin(angle), 0.0))
        return place, Quaternion((0, 0, 1), angle + 0.5 * math.pi)

    return law


def spin(
    place: Sequence[float],
    axis: Sequence[float],
    speed_deg: float,
    *,
    rate_deg: float = 0.0,
    start_deg: float = 0.0,
    tilt: Quaternion | None = None,
) -> Law:
    """About a fixed axis through the origin of the object, which may be a hinge.

    Args:
        place: Position of the origin.
        axis: Axis in the world.
        speed_deg: Speed at t = 0.
        rate_deg: Change of the speed per unit of time.
        start_deg: Angle at t = 0.
        tilt: Rotation before that about the axis.
    """

    def law(t: float) -> tuple[Vector, Quaternion]:
        angle = math.radians(start_deg + speed_deg * t + 0.5 * rate_deg * t * t)
        return Vector(place), Quaternion(Vector(axis).normalized(), angle) @ (tilt or Quaternion())

    return law


def swing(place: Sequence[float], axis: Sequence[float], amplitude_deg: float, period: float, phase_deg: float) -> Law:
    """To and fro about an axis through the origin of the object: amplitude times the sine of 360 t / period + phase."""

    def law(t: float) -> tuple[Vector, Quaternion]:
        angle = math.radians(amplitude_deg) * math.sin(math.tau * t / period + math.radians(phase_deg))
        return Vector(place), Quaternion(Vector(axis).normalized(), angle)

    return law


def throw(
    start: Sequence[float], velocity: Sequence[float], gravity: float, axis: Sequence[float], speed_deg: float
) -> Law:
    """Ballistic flight with constant spin."""
    return glide(start, velocity, (0.0, 0.0, -gravity), axis=axis, speed_deg=speed_deg)


def glide(
    start: Sequence[float],
    velocity: Sequence[float],
    acceleration: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    axis: Sequence[float] = (0.0, 0.0, 1.0),
    start_deg: float = 0.0,
    speed_deg: float = 0.0,
) -> Law:
    """Constant acceleration, and constant spin about an axis in the world."""

    def law(t: float) -> tuple[Vector, Quaternion]:
        place = Vector(start) + t * Vector(velocity) + 0.5 * t * t * Vector(acceleration)
        return place, Quaternion(Vector(axis).normalized(), math.radians(start_deg + speed_deg * t))

    return law


def roll(
    start: Sequence[float],
    direction_deg: float,
    speed: float,
    acceleration: float,
    radius: float,
    *,
    tilt: Quaternion | None = None,
) -> Law:
    """Rolling on level ground without slipping: the angle is the distance divided by the radius.

    Args:
        start: Middle of the rolling object at t = 0.
        direction_deg: Direction of the motion, counter-clockwise from +x.
        speed: Speed at t = 0.
        acceleration: Change of the speed per unit of time.
        radius: Rolling radius.
        tilt: Rotation at t = 0.
    """
    angle = math.radians(direction_deg)
    along, axis = Vector((math.cos(angle), math.sin(angle), 0.0)), Vector((-math.sin(angle), math.cos(angle), 0.0))

    def law(t: float) -> tuple[Vector, Quaternion]:
        way = speed * t + 0.5 * acceleration * t * t
        return Vector(start) + way * along, Quaternion(axis, way / radius) @ (tilt or Quaternion())

    return law


def slide(
    start: Sequence[float], direction_deg: float, speed: float, stop: float, yaw_deg: float, yaw_speed_deg: float
) -> Law:
    """Straight motion and rotation with constant friction, both at rest from the time ``stop`` on."""

    def law(t: float) -> tuple[Vector, Quaternion]:
        s = min(t, stop)
        share = s - 0.5 * s * s / stop
        angle = math.radians(direction_deg)
        place = Vector(start) + speed * share * Vector((math.cos(angle), math.sin(angle), 0.0))
        return place, Quaternion((0, 0, 1), math.radians(yaw_deg + yaw_speed_deg * share))

    return law


def oscillate(
    place: Sequence[float], direction: Sequence[float], amplitude: float, period: float, phase_deg: float
) -> Law:
    """To and fro along a line without turning: amplitude times the sine of 360 t / period + phase."""

    def law(t: float) -> tuple[Vector, Quaternion]:
        share = math.sin(math.tau * t / period + math.radians(phase_deg))
        return Vector(place) + amplitude * share * Vector(direction).normalized(), Quaternion()

    return law
