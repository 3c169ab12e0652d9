"""Motion by Blender's rigid bodies (Bullet), keyed at every frame.

The simulation starts with the given velocities at the first frame, and is replaced by keys: a file that is built has no
rigid bodies. Of two bodies in contact, Bullet multiplies the frictions and the restitutions. Supports have 1 for both,
so a body on a support has its own.

Bullet brakes a body that is closer to another than a hundredth of its size, so that it touches it with less speed and
bounces less than its restitution says. Steps are therefore long: most impacts begin with a penetration, and are exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
from mathutils import Quaternion, Vector

from .motion import FIRST_FRAME, FRAMES_PER_UNIT

GRAVITY = 9.81
"""Acceleration of falling bodies, units per second squared."""

_SCALE = 100.0  # of the simulated world, in which Bullet's tolerances are small
_LIFTED = 2  # steps after an impact, in which Bullet lifts a body out of what it touches
_RAMP = 2  # steps before the first frame, in which bodies are moved with their initial velocity


@dataclass(frozen=True)
class RigidBody:
    """A body and its state at the first frame. Lengths are in units, times in seconds.

    Attributes:
        ob: Blender object with its origin at the centre of mass.
        shape: "SPHERE" or "BOX", as large as the object.
        mass: Mass.
        friction: Coulomb coefficient.
        restitution: Speed after an impact over the speed before it.
        place: Position.
        turn: Rotation.
        velocity: Velocity.
        spin: Angular velocity in the world, rad per second.
    """

    ob: bpy.types.Object
    shape: str
    mass: float
    friction: float
    restitution: float
    place: Vector
    turn: Quaternion
    velocity: Vector
    spin: Vector


@dataclass(frozen=True)
class Path:
    """Simulated poses of a body.

    Attributes:
        places: Positions at each step, from the first frame to the last.
        turns: Rotations.
        step: Seconds between them.
    """

    places: tuple[Vector, ...]
    turns: tuple[Quaternion, ...]
    step: float

    def law(self, t: float) -> tuple[Vector, Quaternion]:
        """Pose at a frame."""
        row = round(t * (len(self.places) - 1))
        return self.places[row].copy(), self.turns[row].copy()


def simulate(
    bodies: Sequence[RigidBody], supports: Sequence[bpy.types.Object], seconds: float, steps: int
) -> list[Path]:
    """Simulate bodies over the scene's timeline.

    Args:
        bodies: The bodies.
        supports: Boxes that stand still, with their axes along those of the world.
        seconds: Length of the timeline.
        steps: Steps of Bullet per frame.
    """
    scene, count = bpy.context.scene, steps * FRAMES_PER_UNIT
    scene.gravity = (0.0, 0.0, -_SCALE * GRAVITY)
    scene.render.fps, scene.render.fps_base = 10 * steps, 10 * seconds / FRAMES_PER_UNIT
    bpy.ops.rigidbody.world_add()
    world = scene.rigidbody_world
    world.substeps_per_frame, world.solver_iterations, world.use_split_impulse = 1, 50, True
    world.point_cache.frame_start, world.point_cache.frame_end = FIRST_FRAME - _RAMP, FIRST_FRAME + count
    for ob in supports:
        ob.location, ob.scale = _SCALE * ob.location, (_SCALE,) * 3
        _add(ob, "PASSIVE", "BOX", 1.0, 1.0)
    for body in bodies:
        _release(body, seconds / count)
    matrices = []
    for frame in range(FIRST_FRAME - _RAMP, FIRST_FRAME + count + 1):
        scene.frame_set(frame)
        matrices.append([body.ob.matrix_world.copy() for body in bodies])
    for ob in (*supports, *(body.ob for body in bodies)):
        with bpy.context.temp_override(object=ob, active_object=ob, selected_objects=[ob]):
            bpy.ops.rigidbody.object_remove()
        ob.animation_data_clear()
        ob.location, ob.scale = ob.location / _SCALE, (1.0,) * 3
    bpy.ops.rigidbody.world_remove()
    scene.render.fps, scene.render.fps_base = 30, 1.0
    found = []
    for column in zip(*matrices[_RAMP:], strict=True):
        places, turns, _ = zip(*(matrix.decompose() for matrix in column), strict=True)
        found.append(Path(tuple(place / _SCALE for place in places), turns, seconds / count))
    return found


def impacts(path: Path, least: float) -> list[float]:
    """Restitution of each impact on something below, from the vertical speeds before and after it.

    Args:
        path: Path of a ball.
        least: Speed below which impacts do not count.
    """
    heights = [place.z for place in path.places]
    speeds = [(b - a) / path.step for a, b in zip(heights, heights[1:], strict=False)]
    lost = GRAVITY * path.step
    pushed = [after - before > -0.5 * lost for before, after in zip(speeds, speeds[1:], strict=False)]
    found, k = [], 0
    while k < len(pushed):
        end = k
        while end < len(pushed) and pushed[end]:
            end += 1
        later = end + _LIFTED
        if end > k and later < len(speeds) and speeds[k] < -least:
            found.append((speeds[later] + (later - k) * lost) / (lost - speeds[k]))
        k = max(end, k + 1)
    return found


def _add(ob: bpy.types.Object, kind: str, shape: str, friction: float, restitution: float) -> None:
    with bpy.context.temp_override(object=ob, active_object=ob, selected_objects=[ob]):
        bpy.ops.rigidbody.object_add(type=kind)
    rigid = ob.rigid_body
    rigid.collision_shape, rigid.friction, rigid.restitution = shape, friction, restitution
    rigid.linear_damping = rigid.angular_damping = 0.0
    rigid.use_deactivation = False


def _release(body: RigidBody, step: float) -> None:
    """Move a body with its velocity up to the first frame, and let it go there. ``step`` is that of frames, s."""
    ob = body.ob
    ob.scale = (_SCALE,) * 3
    _add(ob, "ACTIVE", body.shape, body.friction, body.restitution)
    ob.rigid_body.mass = body.mass
    ob.rotation_mode = "QUATERNION"
    for back in range(_RAMP, -1, -1):
        frame, since = FIRST_FRAME - back, -back * step
        ob.location = _SCALE * (body.place + since * body.velocity)
        ob.rotation_quaternion = Quaternion(body.spin, since * body.spin.length) @ body.turn
        ob.keyframe_insert("location", frame=frame)
        ob.keyframe_insert("rotation_quaternion", frame=frame)
    action = ob.animation_data.action
    owner = action if hasattr(action, "fcurves") else action.layers[0].strips[0].channelbags[0]  # since Blender 5.0
    for curve in owner.fcurves:
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"
    for kinematic, frame in ((True, FIRST_FRAME), (False, FIRST_FRAME + 1)):
        ob.rigid_body.kinematic = kinematic
        ob.keyframe_insert("rigid_body.kinematic", frame=frame)
