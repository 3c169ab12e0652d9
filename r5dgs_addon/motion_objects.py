"""Whole objects and their motion: which anchors are meant, duplicates, removal, and the motion of one for another."""

from collections.abc import Iterable
from dataclasses import dataclass

import bpy
import numpy as np

from ..r5dgs_core import errors
from ..r5dgs_core.motion import rotations
from . import (
    compat,
    motion_confidence,
    motion_curves,
    motion_extrapolate,
    motion_physics,
    objects,
    timeline,
)


def anchor_of(obj: bpy.types.Object | None) -> bpy.types.Object | None:
    """The anchor that an object is, or hangs from."""
    while obj is not None and obj.r5dgs.role != "ANCHOR":
        obj = obj.parent
    return obj


def chosen(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Anchors of the selected objects, each once, in the order of the scene; the active one's where none is selected.

    A cloud that moves with another object than its own does not stand for that one: a prompt selects such clouds, and
    who deletes 'background' keeps the mug that some of it moves with. Anchors that remember no motion are left out.
    """
    selected = context.selected_objects or [context.view_layer.objects.active]
    found = {anchor: None for obj in selected if (anchor := anchor_of(obj)) is not None and not _strays(obj, anchor)}
    return [anchor for anchor in found if motion_physics.has_motion(anchor)]


def _strays(obj: bpy.types.Object, anchor: bpy.types.Object) -> bool:
    """Whether an object is a cloud that hangs from the anchor of another object than its own."""
    return obj.r5dgs.role == "CLOUD" and obj.r5dgs.object_id != anchor.r5dgs.object_id


def active_anchor(context: bpy.types.Context) -> bpy.types.Object | None:
    """The anchor of the active object, where it remembers a motion."""
    anchor = anchor_of(context.view_layer.objects.active)
    return anchor if anchor is not None and motion_physics.has_motion(anchor) else None


def clouds_of(anchor: bpy.types.Object) -> list[bpy.types.Object]:
    """The clouds that an anchor carries."""
    return [child for child in anchor.children if child.r5dgs.role == "CLOUD"]


def duplicate(
    context: bpy.types.Context, anchors: list[bpy.types.Object], offset: tuple[float, float, float], shadows: bool
) -> list[bpy.types.Object]:
    """Copy anchors with their clouds, motion and, if wanted, shadows; each object in a collection of its own.

    The copies share the points of the originals and have actions of their own. Their offset is a delta transform, so
    that keys do not bring them back.

    Args:
        context: Its view layer selects the copies.
        anchors: Anchors of loaded scenes.
        offset: How far the copies stand off, along the axes of the anchors' parents.
        shadows: Whether to copy the anchors that follow these, too.

    Returns:
        The new anchors, in the order of ``anchors``, those of the shadows after them.

    Raises:
        ConfigError: One of them belongs to another .blend file.
    """
    everyone = [*anchors, *(motion_extrapolate.followers(anchors) if shadows else ())]
    for anchor in everyone:
        motion_curves.check_local(anchor)
    homes = {anchor: motion_extrapolate.scene_of(anchor) for anchor in everyone}
    copies: dict[bpy.types.Object, bpy.types.Object] = {}
    with objects.nothing_left_after_error():
        for anchor in everyone:
            name = anchor.name.removesuffix(" anchor")
            collection = bpy.data.collections.new(name)
            (homes[anchor] or context.scene.collection).children.link(collection)
            copy = anchor.copy()
            copy.r5dgs_motion.tube = None
            collection.objects.link(copy)
            _copy_actions(copy)
            copy.delta_location = np.array(copy.delta_location) + np.array(offset)
            for cloud in clouds_of(anchor):
                twin = cloud.copy()
                collection.objects.link(twin)
                twin.parent, twin.matrix_parent_inverse = copy, cloud.matrix_parent_inverse
            copies[anchor] = copy
        for anchor, copy in copies.items():
            for name in ("leader", "learned_leader"):
                leader = getattr(anchor.r5dgs_motion, name)
                setattr(copy.r5dgs_motion, name, copies.get(leader, leader))
        context.view_layer.update()
    for selected in context.selected_objects:
        selected.select_set(False)
    for copy in copies.values():
        for obj in (copy, *clouds_of(copy)):
            obj.select_set(True)
    context.view_layer.objects.active = next(iter(copies.values()), context.view_layer.objects.active)
    return list(copies.values())


def _copy_actions(obj: bpy.types.Object) -> None:
    """Give an object copies of the actions that it plays."""
    animation = obj.animation_data
    if animation is None:
        return
    if animation.action is not None:
        compat.play(obj, animation.action.copy(), compat.slot_of(animation))
    for track in animation.nla_tracks:
        for strip in track.strips:
            if strip.action is not None:
                slot = compat.slot_of(strip)
                strip.action = strip.action.copy()
                compat.choose_slot(strip, slot)


def delete(context: bpy.types.Context, anchors: list[bpy.types.Object], shadows: bool) -> tuple[int, list[str]]:
    """Remove anchors with their clouds, actions, helpers and, if wanted, shadows; emptied collections go, too.

    What else hangs from an anchor stays in its place, without parent. Points that no other object shows are removed.

    Args:
        context: Its view layer is updated.
        anchors: Anchors of loaded scenes.
        shadows: Whether to remove the anchors that follow these, too.

    Returns:
        Number of objects that were removed, and the names of the anchors.

    Raises:
        ConfigError: One of them belongs to another .blend file; nothing was removed.
    """
    everyone = [*anchors, *(motion_extrapolate.followers(anchors) if shadows else ())]
    for anchor in everyone:
        motion_curves.check_local(anchor)
    names = [anchor.name for anchor in everyone]
    removed = [obj for anchor in everyone for obj in (anchor, *clouds_of(anchor))]
    collections = {home for obj in removed for home in obj.users_collection}
    for anchor in everyone:
        motion_confidence.hide(anchor)
        for child in anchor.children:
            if child not in removed:
                place = child.matrix_world.copy()
                child.parent = None
                child.matrix_world = place
    data = {obj.data for obj in removed if obj.data is not None}
    actions = {action for anchor in everyone for action in _actions(anchor)}
    bpy.data.batch_remove(removed)
    bpy.data.batch_remove([item for item in (*data, *actions) if item.users - item.use_fake_user == 0])
    for home in collections:
        if not home.objects and not home.children and not home.r5dgs.is_scene:
            bpy.data.collections.remove(home)
    context.view_layer.update()
    return len(removed), names


def _actions(obj: bpy.types.Object) -> Iterable[bpy.types.Action]:
    animation = obj.animation_data
    if animation is None:
        return
    strips = [strip.action for track in animation.nla_tracks for strip in track.strips]
    yield from (action for action in (animation.action, *strips) if action is not None)


@dataclass(frozen=True)
class Curve:
    """One component of a motion as it will be written: arrays over its keys, handles [K, 2].

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
    """The motion that an anchor will get: everything that can fail is done.

    Attributes:
        target: The anchor.
        source: The anchor that has the motion.
        times: The target's times.
        location: Where the target is while no curve says otherwise. [3]
        quat: How it is turned then, unit wxyz. [4]
        turn: How it is turned against the source in its own frame, unit wxyz. [4]
        curves: Its curves by path and component.
    """

    target: bpy.types.Object
    source: bpy.types.Object
    times: timeline.Times
    location: np.ndarray
    quat: np.ndarray
    turn: np.ndarray
    curves: dict[tuple[str, int], Curve]


def replacement(target: bpy.types.Object, source: bpy.types.Object, frame: float, times: timeline.Times) -> Replacement:
    """What lets an anchor move as another one does, from the pose that it has at a frame.

    Its place moves by what the other's place moves, and it turns by what the other turns, about its own pivot: at
    ``frame`` it is where it was. Its physics become the other's, its learned motion stays its own (`reset` brings it
    back). Curves of other channels stay.

    Args:
        target: The anchor that gets the motion.
        source: The anchor that has it.
        frame: The frame at which the target stays.
        times: The target's times.

    Raises:
        ConfigError: One of them has curves that cannot be read or written.
    """
    here, there = motion_curves.place(target), motion_curves.place(source)
    for obj, where in ((target, here), (source, there)):
        if where.strip is not None:
            raise errors.ConfigError(f"{obj.name}: its motion lies in the NLA; make its action active again first")
    if source.r5dgs_motion.leader is not None:
        raise errors.ConfigError(
            f"{source.name}: follows '{source.r5dgs_motion.leader.name}'; choose that one, or one that follows nobody"
        )
    location, quat = motion_curves.pose_at(target, here, frame)
    from_location, from_quat = motion_curves.pose_at(source, there, frame)
    moves = location - from_location
    turn = rotations.multiply(rotations.conjugate(rotations.normalize(from_quat)), rotations.normalize(quat))
    # q(t) turn is linear in q(t): what mixes the four components.
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


def replace(plan: Replacement) -> None:
    """Write a motion that `replacement` prepared."""
    target = plan.target
    motion_curves.make_own(target)
    motion_extrapolate.clear(target, motion_curves.place(target))
    target.location, target.rotation_quaternion = plan.location, plan.quat
    if plan.curves:
        owned = compat.own_fcurves(target, target.name)
        for (path, index), part in plan.curves.items():
            _write(owned.new(path, index=index), part)
    motion_physics.take(plan.source, target, plan.turn)
    motion_physics.sign(target, plan.times)
    motion_confidence.refresh(target, plan.times)


def _read(curve: bpy.types.FCurve) -> Curve:
    points = curve.keyframe_points
    handles, enums = [], []
    for field in ("co", "handle_left", "handle_right"):
        values = np.empty(2 * len(points), np.float32)
        points.foreach_get(field, values)
        handles.append(values.reshape(-1, 2))
    for field in _ENUMS:
        values = np.empty(len(points), np.int32)
        points.foreach_get(field, values)
        enums.append(values)
    return Curve(*handles, np.stack(enums))


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
    """Curves whose values are a linear map of those of other curves with keys at the same times.

    A curve of one key is taken for one with the keys of the others. [4, 4] maps values of ``parts`` to those wanted.
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
                f"{name}: its rotation curves have keys at different frames, so that they cannot be turned as a whole; "
                "bake them first (Object > Animation > Bake Action), or choose a frame at which both are turned alike"
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


def by_scene(anchors: Iterable[bpy.types.Object]) -> dict[bpy.types.Collection, list[bpy.types.Object]]:
    """Anchors by the loaded scene that they belong to."""
    found: dict[bpy.types.Collection, list[bpy.types.Object]] = {}
    for anchor in anchors:
        collection = motion_extrapolate.scene_of(anchor)
        if collection is not None:
            found.setdefault(collection, []).append(anchor)
    return found


def poll_chosen(cls: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """Whether an operator has objects to act on, for its ``poll``."""
    if context.mode != "OBJECT":
        cls.poll_message_set("Switch to Object Mode first")
        return False
    if not chosen(context):
        cls.poll_message_set("Select an object of an R5DGS scene first")
        return False
    return True
