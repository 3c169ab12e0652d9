"""Contacts of predicted motions: their prediction by the worker, and switching them off and on.

While contacts are off, anchors follow their smooth motions, and store their former keys and motions as text
(`stored_keys`).
"""

import json
from collections.abc import Iterable
from typing import Any

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.motion.models import MotionModel
from ...r5dgs_core.protocol.contacts import ContactRequest
from ..engine import render_request, visible_clouds, visible_meshes
from ..scene import loaded_scenes, timeline
from . import extrapolate, motion_fields, physics, stored_keys


def is_off(anchor: bpy.types.Object) -> bool:
    """Return True if the contacts of an anchor are switched off."""
    return bool(anchor.r5dgs_contact.former) and bool(anchor.r5dgs_motion.taken)


def bodies(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Anchors of a loaded scene whose learned motions have contacts."""
    return [anchor for anchor in loaded_scenes.members(collection, "ANCHOR") if physics.has_contact(anchor)]


def switch_off(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Replace motions with contacts by the smooth ones. Returns the anchors; raises ConfigError, with no change."""
    anchors = [anchor for anchor in bodies(collection) if not is_off(anchor)]
    times = timeline.of_collection(collection)
    extrapolate.check(anchors)
    everyone = [*anchors, *extrapolate.followers(anchors)]
    kept = {anchor: stored_keys.keep(anchor, times) for anchor in everyone}
    for anchor, text in kept.items():
        anchor.r5dgs_contact.former = text
    for anchor in anchors:
        _set_smooth(anchor)
    extrapolate.re_extrapolate(anchors)
    return anchors


def switch_on(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Restore what `switch_off` stored. Returns the anchors; raises ConfigError, with no change."""
    anchors = [anchor for anchor in bodies(collection) if is_off(anchor)]
    times = timeline.of_collection(collection)
    extrapolate.check(anchors)
    for anchor in [*anchors, *extrapolate.followers(anchors)]:
        if anchor.r5dgs_contact.former:
            stored_keys.restore(anchor, anchor.r5dgs_contact.former, times)
            anchor.r5dgs_contact.former = ""
    return anchors


def request(context: bpy.types.Context, collection: bpy.types.Collection) -> ContactRequest:
    """Request for the prediction of a loaded scene, from the fields of the panel.

    Raises:
        SceneFileError: The scene's file is missing.
        ConfigError: The collection to collide with has no mesh, or a part of the loaded scene.
    """
    settings, times = collection.r5dgs_contact, timeline.of_collection(collection)
    frictions, restitutions, masses = {}, {}, {}
    for anchor in _originals(collection):
        own, group = anchor.r5dgs_contact, anchor.r5dgs.motion_id
        if own.use_friction:
            frictions[group] = own.friction
        if own.use_bounciness:
            restitutions[group] = own.bounciness
        if own.mass != 1.0:
            masses[group] = own.mass
    rate = motion_fields.units_per_second(times)
    return ContactRequest(
        scene=str(render_request.scene_path(collection)),
        until=times.t_end,
        frictions=frictions,
        restitutions=restitutions,
        masses=masses,
        gravity=settings.gravity / rate**2 if settings.use_gravity else None,
        obstacles={} if settings.obstacles is None else _obstacles(context, collection, settings.obstacles),
    )


def apply(collection: bpy.types.Collection, answer: dict[str, Any]) -> list[bpy.types.Object]:
    """Write the motions that the worker predicted, and smooth ones to anchors that had contacts before.

    Returns:
        The anchors that were written.

    Raises:
        ConfigError: An anchor cannot be written; nothing was changed.
    """
    predicted = {one["group"]: one for one in answer["motions"]}
    anchors = _originals(collection)
    changed = [one for one in anchors if one.r5dgs.motion_id in predicted or physics.has_contact(one)]
    extrapolate.check(changed)
    for anchor in changed:
        state, own = anchor.r5dgs_motion, anchor.r5dgs_contact
        learned = json.loads(state.learned)
        found = predicted.get(anchor.r5dgs.motion_id)
        if found is None:
            found = {"model": learned["smooth"], "smooth": None, "history": {**learned["history"], "band": None}}
            found["history"] = {name: value for name, value in found["history"].items() if value is not None}
        learned |= {name: found[name] for name in ("model", "smooth", "history", "material") if name in found}
        state.learned, own.former = json.dumps(learned), ""
        physics.show_material(anchor)
        with motion_fields.not_at_once(state):
            physics.reset(anchor)
    for follower in extrapolate.followers(changed):
        follower.r5dgs_contact.former = ""
    collection.r5dgs_contact.result = _summary(answer)
    return extrapolate.re_extrapolate(changed) if changed else []


def _summary(answer: dict[str, Any]) -> str:
    taken = [f"{name}: {text}" for name, text in answer["taken"].items()]
    return "; ".join([*(taken or ["Nothing touches anything"]), *answer["lines"]])


def _originals(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Anchors with a motion of their own in the scene file; copies move as their fields say."""
    found: dict[int, bpy.types.Object] = {}
    for anchor in loaded_scenes.members(collection, "ANCHOR"):
        if physics.has_motion(anchor) and anchor.r5dgs.motion_id and anchor.r5dgs_motion.leader is None:
            found.setdefault(anchor.r5dgs.motion_id, anchor)
    return list(found.values())


def _set_smooth(anchor: bpy.types.Object) -> None:
    state = anchor.r5dgs_motion
    smooth = json.loads(state.learned)["smooth"]
    with motion_fields.not_at_once(state):
        state.taken = json.dumps(smooth)
        physics.set_fields(state, MotionModel.from_dict(smooth))


def _obstacles(
    context: bpy.types.Context, collection: bpy.types.Collection, meshes: bpy.types.Collection
) -> dict[str, np.ndarray]:
    """Corners of the surfaces of a collection by name, in the world of a loaded scene, now. [V, 3] each"""
    objects = [obj for obj in meshes.all_objects if obj.type in visible_meshes.SURFACES]
    own = _of_scenes(objects)
    if own or not objects:
        found = f"found {', '.join(own)} of a loaded scene" if own else "found none"
        raise errors.ConfigError(f"{meshes.name}: expected meshes to collide with, {found}")
    depsgraph = context.evaluated_depsgraph_get()
    back, found = np.linalg.inv(visible_clouds.world_of(collection)), {}
    for obj in objects:
        evaluated = obj.evaluated_get(depsgraph)
        matrix = back @ np.array(evaluated.matrix_world, np.float64)
        found[obj.name] = visible_meshes.corners(evaluated) @ matrix[:3, :3].T + matrix[:3, 3]
    return found


def _of_scenes(objects: Iterable[bpy.types.Object]) -> list[str]:
    return [obj.name for obj in objects if obj.r5dgs.role != "NONE"]
