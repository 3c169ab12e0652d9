"""Whole objects with their motion: which anchors are meant, duplicates and removal."""

from collections.abc import Iterable

import bpy
import numpy as np

from .. import compat
from ..scene import loaded_scenes
from . import confidence_tubes, extrapolate, fcurves, physics


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
    return [anchor for anchor in found if physics.has_motion(anchor)]


def _strays(obj: bpy.types.Object, anchor: bpy.types.Object) -> bool:
    """Whether an object is a cloud that hangs from the anchor of another object than its own."""
    return obj.r5dgs.role == "CLOUD" and obj.r5dgs.object_id != anchor.r5dgs.object_id


def active_anchor(context: bpy.types.Context) -> bpy.types.Object | None:
    """The anchor of the active object, where it remembers a motion."""
    anchor = anchor_of(context.view_layer.objects.active)
    return anchor if anchor is not None and physics.has_motion(anchor) else None


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
    everyone = [*anchors, *(extrapolate.followers(anchors) if shadows else ())]
    for anchor in everyone:
        fcurves.check_local(anchor)
    homes = {anchor: extrapolate.scene_of(anchor) for anchor in everyone}
    copies: dict[bpy.types.Object, bpy.types.Object] = {}
    with loaded_scenes.nothing_left_after_error():
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
    everyone = [*anchors, *(extrapolate.followers(anchors) if shadows else ())]
    for anchor in everyone:
        fcurves.check_local(anchor)
    names = [anchor.name for anchor in everyone]
    removed = [obj for anchor in everyone for obj in (anchor, *clouds_of(anchor))]
    collections = {home for obj in removed for home in obj.users_collection}
    for anchor in everyone:
        confidence_tubes.hide(anchor)
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


def by_scene(anchors: Iterable[bpy.types.Object]) -> dict[bpy.types.Collection, list[bpy.types.Object]]:
    """Anchors by the loaded scene that they belong to."""
    found: dict[bpy.types.Collection, list[bpy.types.Object]] = {}
    for anchor in anchors:
        collection = extrapolate.scene_of(anchor)
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
