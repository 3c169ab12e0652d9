"""Duplication and deletion of whole objects with their motion, and lookup of the selected anchors."""

from collections.abc import Iterable

import bpy
import numpy as np

from .. import compat
from ..scene import loaded_scenes
from . import confidence_tubes, curve_place, extrapolate, physics


def anchor_of(obj: bpy.types.Object | None) -> bpy.types.Object | None:
    """Anchor that an object is or is parented to, or None."""
    while obj is not None and obj.r5dgs.role != "ANCHOR":
        obj = obj.parent
    return obj


def chosen(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Anchors of the selected objects in scene order, without duplicates; of the active object if none is selected.

    A point cloud that moves with another object does not select that object's anchor: deleting 'background' must keep
    the mug that some background Gaussians move with. Anchors without a learned motion are excluded.
    """
    selected = context.selected_objects or [context.view_layer.objects.active]
    found = {anchor: None for obj in selected if (anchor := anchor_of(obj)) is not None and not _strays(obj, anchor)}
    return [anchor for anchor in found if physics.has_motion(anchor)]


def _strays(obj: bpy.types.Object, anchor: bpy.types.Object) -> bool:
    """True if an object is a point cloud whose anchor belongs to another object."""
    return obj.r5dgs.role == "CLOUD" and obj.r5dgs.object_id != anchor.r5dgs.object_id


def active_anchor(context: bpy.types.Context) -> bpy.types.Object | None:
    """Anchor of the active object, or None if it has no learned motion."""
    anchor = anchor_of(context.view_layer.objects.active)
    return anchor if anchor is not None and physics.has_motion(anchor) else None


def clouds_of(anchor: bpy.types.Object) -> list[bpy.types.Object]:
    """Point clouds parented to an anchor."""
    return [child for child in anchor.children if child.r5dgs.role == "CLOUD"]


def duplicate(
    context: bpy.types.Context, anchors: list[bpy.types.Object], offset: tuple[float, float, float], shadows: bool
) -> list[bpy.types.Object]:
    """Copy anchors with their parts, point clouds, motion and, optionally, shadows, each into a collection of its own.

    The copies share the points of the originals and have their own actions. Their offset is a delta transform, which
    keyframes do not overwrite.

    Args:
        context: Context whose view layer selects the copies.
        anchors: Anchors of loaded scenes.
        offset: Offset of the copies in the axes of the anchors' parents.
        shadows: True to copy the anchors that follow these, too.

    Returns:
        The new anchors in the order of ``anchors``, followed by those of further parts and of the shadows.

    Raises:
        ConfigError: An anchor belongs to another .blend file.
    """
    anchors = extrapolate.with_parts(anchors)
    everyone = [*anchors, *(extrapolate.followers(anchors) if shadows else ())]
    for anchor in everyone:
        curve_place.check_local(anchor)
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
            if anchor.parent in copies:
                copy.parent, copy.matrix_parent_inverse = copies[anchor.parent], anchor.matrix_parent_inverse
            else:
                copy.delta_location = np.array(copy.delta_location) + np.array(offset)
            for cloud in clouds_of(anchor):
                twin = cloud.copy()
                collection.objects.link(twin)
                _copy_actions(twin)
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
    """Copy all actions of an object, so that it shares none."""
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
    """Remove anchors with their parts, point clouds, actions, helpers and, optionally, shadows, and empty collections.

    Other children of an anchor are unparented and keep their world transform. Unused points are removed.

    Args:
        context: Context whose view layer is updated.
        anchors: Anchors of loaded scenes.
        shadows: True to remove the anchors that follow these, too.

    Returns:
        Number of removed objects, and the names of the anchors.

    Raises:
        ConfigError: An anchor belongs to another .blend file; nothing was removed.
    """
    anchors = extrapolate.with_parts(anchors)
    everyone = [*anchors, *(extrapolate.followers(anchors) if shadows else ())]
    for anchor in everyone:
        curve_place.check_local(anchor)
    names = [anchor.name for anchor in everyone]
    removed = [obj for anchor in everyone for obj in (anchor, *clouds_of(anchor))]
    collections = list(dict.fromkeys(home for obj in removed for home in obj.users_collection))
    collections.sort(key=lambda home: len(home.children_recursive))  # a collection is emptied after those inside it
    for anchor in everyone:
        confidence_tubes.hide(anchor)
        for child in anchor.children:
            if child not in removed:
                place = child.matrix_world.copy()
                child.parent = None
                child.matrix_world = place
    data = {obj.data for obj in removed if obj.data is not None}
    actions = {action for obj in removed for action in _actions(obj)}
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
    """Group anchors by the loaded scene that they belong to."""
    found: dict[bpy.types.Collection, list[bpy.types.Object]] = {}
    for anchor in anchors:
        collection = extrapolate.scene_of(anchor)
        if collection is not None:
            found.setdefault(collection, []).append(anchor)
    return found


def poll_chosen(cls: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """``poll`` of operators that act on the selected objects."""
    if context.mode != "OBJECT":
        cls.poll_message_set("Switch to Object Mode first")
        return False
    if not chosen(context):
        cls.poll_message_set("Select an object of an R5DGS scene first")
        return False
    return True
