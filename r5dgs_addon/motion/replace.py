"""Transfer of a motion to another anchor: its curves, moved and rotated to the target's pose, and its physics."""

from dataclasses import dataclass

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.motion import rotations
from .. import compat
from ..scene import timeline
from . import confidence_tubes, curve_place, extrapolate, fcurves, physics


@dataclass(frozen=True)
class Curve:
    """One component of a motion to be written, as arrays over its keys. Points and handles [K, 2].

    Attributes:
        co: Frames and values.
        left: Left handles.
        right: Right handles.
        enums: Interpolation, both handle types and key type of each key. [4, K]
    """

    co: np.ndarray
    left: np.ndarray
    right: np.ndarray
    enums: np.ndarray


_ENUMS = ("interpolation", "handle_left_type", "handle_right_type", "type")


@dataclass(frozen=True)
class Replacement:
    """Motion to be written to an anchor. All checks that can fail are done.

    Attributes:
        target: Anchor that receives the motion.
        source: Anchor with the motion.
        times: Times of the target.
        location: Location of the target without curves. [3]
        quat: Rotation of the target without curves, unit wxyz. [4]
        turn: Rotation of the target relative to the source, in the frame of the source, unit wxyz. [4]
        curves: Curves by data path and component.
    """

    target: bpy.types.Object
    source: bpy.types.Object
    times: timeline.Times
    location: np.ndarray
    quat: np.ndarray
    turn: np.ndarray
    curves: dict[tuple[str, int], Curve]


def prepare(target: bpy.types.Object, source: bpy.types.Object, frame: float, times: timeline.Times) -> Replacement:
    """Prepare a transfer of motion that keeps the target's pose at a frame.

    The target moves by the displacement of the source and turns by its rotation, about its own pivot. It takes over the
    source's physics, but keeps its own learned motion for *Reset to Learned*. Curves of other channels are kept.

    Args:
        target: Anchor that receives the motion.
        source: Anchor with the motion.
        frame: Frame at which the target keeps its pose.
        times: Times of the target.

    Raises:
        ConfigError: Curves of an anchor cannot be read or written.
    """
    here, there = curve_place.find(target), curve_place.find(source)
    for obj, where in ((target, here), (source, there)):
        if where.strip is not None:
            raise errors.ConfigError(f"{obj.name}: its motion is in the NLA; make its action active again first")
    if source.r5dgs_motion.leader is not None:
        raise errors.ConfigError(
            f"{source.name}: follows '{source.r5dgs_motion.leader.name}'; choose the leader or an object without a "
            "leader"
        )
    location, quat = fcurves.pose_at(target, here, frame)
    from_location, from_quat = fcurves.pose_at(source, there, frame)
    moves = location - from_location
    turn = rotations.multiply(rotations.conjugate(rotations.normalize(from_quat)), rotations.normalize(quat))
    # The product q(t) turn is linear in q(t); `mix` is its matrix.
    mix = np.stack([rotations.multiply(row, turn) for row in np.eye(4)], axis=-1)
    curves = there.curves()
    written: dict[tuple[str, int], Curve] = {}
    for index in range(3):
        if ("location", index) in curves:
            written["location", index] = _moved(_read(curves["location", index]), moves[index])
    turning = {
        index: curves["rotation_quaternion", index] for index in range(4) if ("rotation_quaternion", index) in curves
    }
    if turning:
        parts = [
            _read(turning[i]) if i in turning else _constant(frame, source.rotation_quaternion[i]) for i in range(4)
        ]
        parts = parts if np.allclose(turn, [1, 0, 0, 0], atol=1e-7) else _mixed(source.name, parts, mix)
        written.update({("rotation_quaternion", index): part for index, part in enumerate(parts)})
    return Replacement(target, source, times, location, rotations.normalize(quat), turn, written)


def apply(plan: Replacement) -> None:
    """Write the result of `prepare`."""
    target = plan.target
    curve_place.make_own(target)
    extrapolate.clear(target, curve_place.find(target))
    target.location, target.rotation_quaternion = plan.location, plan.quat
    if plan.curves:
        owned = compat.own_fcurves(target, target.name)
        for (path, index), part in plan.curves.items():
            _write(owned.new(path, index=index), part)
    physics.copy_motion(plan.source, target, plan.turn)
    physics.store_digests(target, plan.times)
    confidence_tubes.refresh(target, plan.times)


def _read(curve: bpy.types.FCurve) -> Curve:
    points = fcurves.KeyArrays(curve)
    return Curve(points.co, points.left, points.right, fcurves.enums(curve, _ENUMS))


def _constant(frame: float, value: float) -> Curve:
    co = np.array([[frame, value]], np.float32)
    enums = [
        compat.keyframe_enum(f, item) for f, item in zip(_ENUMS, ("BEZIER", "FREE", "FREE", "KEYFRAME"), strict=True)
    ]
    return Curve(co, co - np.float32([1, 0]), co + np.float32([1, 0]), np.array(enums, np.int32)[:, None])


def _moved(curve: Curve, by: float) -> Curve:
    up = np.array([0.0, by])
    return Curve(curve.co + up, curve.left + up, curve.right + up, curve.enums)


def _mixed(name: str, parts: list[Curve], mix: np.ndarray) -> list[Curve]:
    """Apply a linear map to the values of curves whose keys are at the same frames.

    A curve with one key is treated as constant over the keys of the others. ``mix`` [4, 4] maps old values to new ones.
    """
    longest = max(parts, key=lambda part: len(part.co))
    for k, part in enumerate(parts):
        if len(part.co) == 1 and len(longest.co) > 1:
            flat = [np.stack([a[:, 0], np.full(len(a), part.co[0, 1])], axis=-1) for a in _arrays(longest)]
            parts[k] = Curve(*flat, longest.enums)
    for part in parts:
        same = len(part.co) == len(longest.co) and all(
            np.allclose(a[:, 0], b[:, 0], atol=1e-3) for a, b in zip(_arrays(part), _arrays(longest), strict=True)
        )
        if not same:
            raise errors.ConfigError(
                f"{name}: its rotation curves have keys at different frames, so they cannot be rotated together; "
                "bake them first (Object > Animation > Bake Action), or choose a frame at which both have the same "
                "rotation"
            )
    result = []
    for row in mix:
        arrays = []
        for whole in zip(*(_arrays(part) for part in parts), strict=True):
            values = sum(weight * array[:, 1].astype(np.float64) for weight, array in zip(row, whole, strict=True))
            arrays.append(np.stack([whole[0][:, 0], values], axis=-1))
        result.append(Curve(*arrays, longest.enums))
    return result


def _arrays(curve: Curve) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return curve.co, curve.left, curve.right


def _write(curve: bpy.types.FCurve, part: Curve) -> None:
    points = curve.keyframe_points
    points.add(len(part.co))
    for field, values in zip(_ENUMS, part.enums, strict=True):
        points.foreach_set(field, np.ascontiguousarray(values, np.int32))
    for field, values in zip(("co", "handle_left", "handle_right"), _arrays(part), strict=True):
        points.foreach_set(field, np.ascontiguousarray(values, np.float32).ravel())
    curve.update()
