"""Extrapolation: write the keys of anchors past t_max from the motion in their fields.

The new motion starts from the pose of the F-curves at t_max, including the user's edits. It is continuous there, and a
rotation turns the object about its own position. Without edits it is the learned motion.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.motion import key_reduction as reduction
from ...r5dgs_core.motion import models, rotations
from ...r5dgs_core.motion.cubic_curves import Keys
from ...r5dgs_core.playback import group_curves
from ...r5dgs_core.scene import scene_file
from ...r5dgs_core.scene.scene import Scene
from .. import compat
from ..scene import loaded_scenes, timeline
from . import confidence_tubes, curve_place, fcurves, keyframes, motion_fields, physics

MAX_STEPS = 1024  # maximum integration steps per observed span; exceeded only by orbits about far-away points


@dataclass(frozen=True)
class PendingKeys:
    """Keys to be written for one anchor. All checks that can fail are done.

    Attributes:
        anchor: Anchor.
        place: Location of its F-curves.
        times: Times of its scene, with the new end.
        tails: Keys over frames by data path.
        too_fast: True if the motion is too fast for keys, which are then exact only at frames.
    """

    anchor: bpy.types.Object
    place: curve_place.Place
    times: timeline.Times
    tails: dict[str, Keys]
    too_fast: bool


def scene_of(anchor: bpy.types.Object) -> bpy.types.Collection | None:
    """Loaded scene that an object belongs to, or None."""
    for collection in loaded_scenes.scene_collections():
        if anchor.name in collection.all_objects and collection.all_objects[anchor.name] == anchor:
            return collection
    return None


def followers(anchors: Iterable[bpy.types.Object]) -> list[bpy.types.Object]:
    """Anchors that follow one of the given anchors and are not among them, such as shadows."""
    leaders = set(anchors)
    return [
        obj
        for obj in bpy.data.objects
        if obj.r5dgs.role == "ANCHOR" and obj not in leaders and obj.r5dgs_motion.leader in leaders
    ]


def with_parts(anchors: Iterable[bpy.types.Object]) -> list[bpy.types.Object]:
    """Return the given anchors, followed by those of the parts that they carry."""
    found = list(dict.fromkeys(anchors))
    for anchor in found:
        found += [child for child in anchor.children if child.r5dgs.role == "ANCHOR" and child not in found]
    return found


def re_extrapolate(anchors: list[bpy.types.Object], t_end: float | None = None) -> list[bpy.types.Object]:
    """Write the keys past t_max of anchors and their followers from their motions.

    Args:
        anchors: Anchors of loaded scenes.
        t_end: Last scene time; None for that of each scene.

    Returns:
        The anchors that were written.

    Raises:
        ConfigError: An anchor cannot be written; nothing was changed.
    """
    everyone = [*anchors, *followers(anchors)]
    for plan in _plans(everyone, t_end):
        _apply(plan)
    return everyone


def _plans(anchors: list[bpy.types.Object], t_end: float | None) -> list[PendingKeys]:
    most = keyframes.intervals_per_object(len(anchors))
    return [_plan(anchor, t_end, most) for anchor in anchors]


def _plan(anchor: bpy.types.Object, t_end: float | None, most: int) -> PendingKeys:
    times, place = times_of(anchor, t_end), curve_place.find(anchor)
    location, quat = fcurves.pose_at(anchor, place, times.frame(times.t_max))
    tails, too_fast = {}, False
    if times.t_end > times.t_max:
        allowed, reach = physics.key_error(anchor)
        sample, model = _sampler(anchor, location, quat, times, most)
        stop = physics.stop_time(physics.mover(anchor))
        sample = group_curves.stopped(sample, times.t_max, stop)
        future = keyframes.reduced_keys(sample, times.t_max, times, allowed, reach, most, model, stop)
        too_fast = not future.followed
        tails = {
            "location": fcurves.frames(future.location, times),
            "rotation_quaternion": fcurves.frames(future.rotation, times),
        }
    return PendingKeys(anchor, place, times, tails, too_fast)


def _apply(plan: PendingKeys) -> None:
    anchor, place = plan.anchor, plan.place
    if place.strip is None and place.action is not None:
        curve_place.make_own(anchor)
        place = curve_place.find(anchor)
    fcurves.replace_after(anchor, place, plan.times.frame(plan.times.t_max), plan.tails)
    physics.store_digests(anchor, plan.times)
    anchor.r5dgs_motion.too_fast = plan.too_fast
    confidence_tubes.refresh(anchor, plan.times)


def times_of(anchor: bpy.types.Object, t_end: float | None = None) -> timeline.Times:
    """Times of the scene that an anchor belongs to, optionally with another end.

    Raises:
        ConfigError: The anchor belongs to no scene, or was loaded by a version that did not store motions.
    """
    collection = scene_of(anchor)
    if collection is None or not physics.has_motion(anchor):
        raise errors.ConfigError(
            f"{anchor.name}: expected an anchor of a loaded scene with a stored motion, found none; load the scene "
            "again"
        )
    times = timeline.of_collection(collection)
    return times if t_end is None else replace(times, t_end=max(t_end, times.t_max))


def _sampler(
    anchor: bpy.types.Object, location: np.ndarray, quat: np.ndarray, times: timeline.Times, most: int
) -> tuple[reduction.Sampler, models.MotionModel]:
    """Return a sampler of the poses past t_max, which starts from the pose at t_max, and its model.

    The sampled quaternions have the norm of that pose, because keys need not be unit quaternions.

    Raises:
        ConfigError: The motion is invalid, or would take minutes to integrate.
    """
    follow, mover = physics.follow_matrix(anchor.r5dgs_motion), physics.mover(anchor)
    model = physics.model(mover)
    if follow is None and model.inertia is not None:
        turn = rotations.quats_to_rotmats(rotations.normalize(quat))
        model = replace(model, inertia=turn @ model.inertia @ turn.T)
    span = min(times.t_end - times.t_max, max(times.t_max - times.t_start, 1 / times.frames_per_unit))
    if models.steps_needed(model, np.array([span]))[0] > MAX_STEPS:
        raise errors.ConfigError(
            f"{mover.name}: the orbit is too fast or too large to integrate; lower the rates, or choose Throw and Spin"
        )
    poses = reduction.model_sampler(model, times.t_max, most)

    def sample(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        quats, displacements, quat_slopes, slopes = poses(at)
        if follow is not None:
            still = np.broadcast_to(quat, quats.shape).copy()
            return still, location + displacements @ follow.T, np.zeros_like(quats), slopes @ follow.T
        return (
            rotations.multiply(quats, quat),
            location + displacements,
            rotations.multiply(quat_slopes, quat),
            slopes,
        )

    return sample, model


def extrapolate_until(
    context: bpy.types.Context, collection: bpy.types.Collection, t_end: float, fit_timeline: bool
) -> tuple[list[bpy.types.Object], list[bpy.types.Object]]:
    """Extend or shorten the extrapolation of a loaded scene.

    Anchors whose keys past t_max were edited by hand are not changed.

    Args:
        context: Context whose scene has the frame range.
        collection: Loaded scene.
        t_end: Last scene time, clamped to t_max.
        fit_timeline: True to update the end of the frame range.

    Returns:
        The anchors that were written, and those that were skipped.

    Raises:
        ConfigError: The end is too late, or an anchor cannot be written; nothing was changed.
    """
    times = timeline.of_collection(collection)
    timeline.check_end(collection.name, replace(times, t_end=t_end))
    anchors = [anchor for anchor in loaded_scenes.members(collection, "ANCHOR") if physics.has_motion(anchor)]
    kept = [anchor for anchor in anchors if physics.hand_edited(anchor, times)]
    plans = _plans([anchor for anchor in anchors if anchor not in kept], t_end)
    for plan in plans:
        _apply(plan)
    collection.r5dgs.t_end = max(t_end, times.t_max)
    if fit_timeline:
        timeline.fit_end(context.scene, timeline.of_collection(collection))
    return [plan.anchor for plan in plans], kept


def reset(anchors: list[bpy.types.Object]) -> list[bpy.types.Object]:
    """Reset the fields of anchors to the learned motion, and write their keys past t_max.

    Returns:
        The anchors that were written.

    Raises:
        ConfigError: An anchor cannot be written; nothing was changed.
    """
    check(anchors)
    for anchor in anchors:
        physics.reset(anchor)
    return re_extrapolate(anchors)


def check(anchors: list[bpy.types.Object], curves: bool = True) -> None:
    """Raise a ConfigError if anchors cannot be reset, or if one of their followers cannot be written.

    Args:
        anchors: Anchors.
        curves: True if their curves up to t_max are kept; it must then be possible to split these at t_max.
    """
    for anchor in [*anchors, *followers(anchors)]:
        times, place = times_of(anchor), curve_place.find(anchor)
        if curves or anchor not in anchors:
            fcurves.pose_at(anchor, place, times.frame(times.t_max))
        leader = anchor.r5dgs_motion.learned_leader if anchor in anchors else None
        if leader is not None and leader not in anchors:
            physics.model(leader)


def read_source(anchors: list[bpy.types.Object], path: Path) -> Scene:
    """Read the scene that anchors were made from, for `reload`.

    Args:
        anchors: Anchors of one loaded scene.
        path: Its file.

    Raises:
        R5dgsError: The file cannot be read or is that of another scene, or an anchor cannot be written.
    """
    for anchor in anchors:
        if curve_place.find(anchor).strip is not None:
            raise errors.ConfigError(f"{anchor.name}: its action is in the NLA; make it active again first")
    scene = scene_file.read(path)
    for anchor in anchors:
        motion_id = anchor.r5dgs.motion_id
        pivot = np.float32(scene.groups[motion_id].home) if motion_id < len(scene.groups) else None
        if pivot is None or (motion_id and (np.array(anchor.r5dgs.pivot, np.float32) != pivot).any()):
            raise errors.SceneFileError(f"{path}: expected the scene of '{anchor.name}', found another; load it again")
    return scene


def reload(anchors: list[bpy.types.Object], scene: Scene) -> None:
    """Restore the curves of anchors from their scene file, including the observed time, up to the scene's end.

    The user's location and rotation curves are replaced. Other curves, such as scale, are kept.

    Args:
        anchors: Anchors of one loaded scene.
        scene: Result of `read_source` for them.
    """
    for anchor in anchors:
        times = times_of(anchor)
        curve_place.make_own(anchor)
        place = curve_place.find(anchor)
        clear(anchor, place)
        anchor.location, anchor.rotation_quaternion = anchor.r5dgs.pivot, (1.0, 0.0, 0.0, 0.0)
        allowed, reach = physics.key_error(anchor)
        exact = replace(times, t_max=float(scene.t_max))
        keyframes.animate(anchor, scene, anchor.r5dgs.motion_id, exact, allowed / scene.extent, reach)
        physics.reset(anchor)
        physics.store_digests(anchor, times)
        confidence_tubes.refresh(anchor, times)


def clear(anchor: bpy.types.Object, place: curve_place.Place) -> None:
    """Remove an anchor's location and rotation curves."""
    curves = place.curves()
    if not curves:
        return
    owned = compat.channels(place.action, place.slot)
    for curve in curves.values():
        owned.remove(curve)


def register():
    """Re-extrapolate an anchor when its fields change."""
    motion_fields.call_on_change(re_extrapolate)


def unregister():
    """Undo `register`."""
    motion_fields.call_on_change(None)
