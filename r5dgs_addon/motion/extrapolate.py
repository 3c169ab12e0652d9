"""Write what anchors do past t_max anew, from the motion that their fields describe.

The new motion starts from the pose that the curves have at t_max, wherever the user has brought it: it is continuous
there, and a rotation acts on the turned object about its own place. Where nothing was edited it is the learned motion.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.motion import key_reduction as reduction
from ...r5dgs_core.motion import models, rotations
from ...r5dgs_core.motion.key_reduction import Keys
from ...r5dgs_core.scene import scene_file
from ...r5dgs_core.scene.scene import Scene
from .. import compat
from ..scene import loaded_scenes, timeline
from . import confidence_tubes, fcurves, keyframes, physics

MOST_STEPS = 1024  # of integration over as long as was observed: beyond are orbits about places far out of sight


@dataclass(frozen=True)
class Plan:
    """What will be written for one anchor: everything that can fail is done.

    Attributes:
        anchor: The anchor.
        place: Where its curves lie.
        times: Its times, with the new end.
        tails: Keys by path, over frames.
        too_fast: True if the motion is too fast for keys, which then are exact only at frames.
    """

    anchor: bpy.types.Object
    place: fcurves.Place
    times: timeline.Times
    tails: dict[str, Keys]
    too_fast: bool


def scene_of(anchor: bpy.types.Object) -> bpy.types.Collection | None:
    """The loaded scene that an object belongs to."""
    for collection in loaded_scenes.scene_collections():
        if anchor.name in collection.all_objects and collection.all_objects[anchor.name] == anchor:
            return collection
    return None


def followers(anchors: Iterable[bpy.types.Object]) -> list[bpy.types.Object]:
    """Anchors that take the path of one of these and are none of them, such as shadows."""
    leaders = set(anchors)
    return [
        obj
        for obj in bpy.data.objects
        if obj.r5dgs.role == "ANCHOR" and obj not in leaders and obj.r5dgs_motion.leader in leaders
    ]


def re_extrapolate(anchors: list[bpy.types.Object], t_end: float | None = None) -> list[bpy.types.Object]:
    """Write the keys past t_max of anchors, and of what follows them, from their motions.

    Args:
        anchors: Anchors of loaded scenes.
        t_end: Last scene time; None for that of each scene.

    Returns:
        The anchors that were written.

    Raises:
        ConfigError: One of them cannot be; nothing was written.
    """
    everyone = [*anchors, *followers(anchors)]
    for plan in _plans(everyone, t_end):
        _apply(plan)
    return everyone


def _plans(anchors: list[bpy.types.Object], t_end: float | None) -> list[Plan]:
    most = keyframes.share(len(anchors))
    return [_plan(anchor, t_end, most) for anchor in anchors]


def _plan(anchor: bpy.types.Object, t_end: float | None, most: int) -> Plan:
    times, place = times_of(anchor, t_end), fcurves.place(anchor)
    location, quat = fcurves.pose_at(anchor, place, times.frame(times.t_max))
    tails, too_fast = {}, False
    if times.t_end > times.t_max:
        allowed, reach = physics.key_error(anchor)
        sample = _sampler(anchor, location, quat, times, most)
        future = keyframes.few(sample, times.t_max, times, allowed, reach, most)
        too_fast = not future.followed
        tails = {
            "location": fcurves.frames(future.location, times),
            "rotation_quaternion": fcurves.frames(future.rotation, times),
        }
    return Plan(anchor, place, times, tails, too_fast)


def _apply(plan: Plan) -> None:
    anchor, place = plan.anchor, plan.place
    if place.strip is None and place.action is not None:
        fcurves.make_own(anchor)
        place = fcurves.place(anchor)
    fcurves.replace_after(anchor, place, plan.times.frame(plan.times.t_max), plan.tails)
    physics.sign(anchor, plan.times)
    anchor.r5dgs_motion.too_fast = plan.too_fast
    confidence_tubes.refresh(anchor, plan.times)


def times_of(anchor: bpy.types.Object, t_end: float | None = None) -> timeline.Times:
    """The times of the scene that an anchor belongs to, with another end if one is given.

    Raises:
        ConfigError: It belongs to none, or is from before motions were remembered.
    """
    collection = scene_of(anchor)
    if collection is None or not physics.has_motion(anchor):
        raise errors.ConfigError(
            f"{anchor.name}: expected the anchor of a loaded scene, found none of a motion; load the scene again"
        )
    times = timeline.of_collection(collection)
    return times if t_end is None else replace(times, t_end=max(t_end, times.t_max))


def _sampler(
    anchor: bpy.types.Object, location: np.ndarray, quat: np.ndarray, times: timeline.Times, most: int
) -> reduction.Sampler:
    """Poses past t_max that continue one at t_max: quaternions as long as that is, as keys may be.

    Raises:
        ConfigError: The motion cannot be, or would take minutes to integrate.
    """
    follow, mover = physics.follow_matrix(anchor.r5dgs_motion), physics.mover(anchor)
    model = physics.model(mover)
    if follow is None and model.inertia is not None:
        turn = rotations.quats_to_rotmats(rotations.normalize(quat))
        model = replace(model, inertia=turn @ model.inertia @ turn.T)
    span = min(times.t_end - times.t_max, max(times.t_max - times.t_start, 1 / times.frames_per_unit))
    if models.steps_needed(model, np.array([span]))[0] > MOST_STEPS:
        raise errors.ConfigError(
            f"{mover.name}: an orbit this fast or far off cannot be integrated; take smaller rates, or Throw and Spin"
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

    return sample


def extrapolate_until(
    context: bpy.types.Context, collection: bpy.types.Collection, t_end: float, fit_timeline: bool
) -> tuple[list[bpy.types.Object], list[bpy.types.Object]]:
    """Extend or shorten the future of a loaded scene.

    Anchors whose keys past t_max were edited by hand are left alone.

    Args:
        context: Its scene has the frame range.
        collection: The loaded scene.
        t_end: Last scene time; one before t_max counts as t_max.
        fit_timeline: Whether the frame range follows.

    Returns:
        The anchors that were written, and those that were left alone.

    Raises:
        ConfigError: The end is too far, or an anchor cannot be written; nothing was.
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
    """Bring the fields of anchors back to the learned motion, and the keys past t_max with them.

    Returns:
        The anchors that were written.

    Raises:
        ConfigError: One of them cannot be; nothing was changed.
    """
    check(anchors)
    for anchor in anchors:
        physics.reset(anchor)
    return re_extrapolate(anchors)


def check(anchors: list[bpy.types.Object], curves: bool = True) -> None:
    """Refuse, with a ConfigError, to reset anchors that cannot be written, or that something follows which cannot.

    Args:
        anchors: The anchors.
        curves: Whether they keep their curves up to t_max, which have to be such as can be cut there.
    """
    for anchor in [*anchors, *followers(anchors)]:
        times, place = times_of(anchor), fcurves.place(anchor)
        if curves or anchor not in anchors:
            fcurves.pose_at(anchor, place, times.frame(times.t_max))
        leader = anchor.r5dgs_motion.learned_leader if anchor in anchors else None
        if leader is not None and leader not in anchors:
            physics.model(leader)


def source(anchors: list[bpy.types.Object], path: Path) -> Scene:
    """The scene that anchors were made from, for `reload`.

    Args:
        anchors: Anchors of one loaded scene.
        path: Its file.

    Raises:
        R5dgsError: The file cannot be read or is of another scene, or an anchor cannot be written.
    """
    for anchor in anchors:
        if fcurves.place(anchor).strip is not None:
            raise errors.ConfigError(f"{anchor.name}: its action lies in the NLA; make it active again first")
    scene = scene_file.read(path)
    for anchor in anchors:
        motion_id = anchor.r5dgs.motion_id
        pivot = np.float32(scene.groups[motion_id].pivot) if motion_id < len(scene.groups) else None
        if pivot is None or (motion_id and (np.array(anchor.r5dgs.pivot, np.float32) != pivot).any()):
            raise errors.SceneFileError(f"{path}: expected the scene of '{anchor.name}', found another; load it anew")
    return scene


def reload(anchors: list[bpy.types.Object], scene: Scene) -> None:
    """Give anchors the curves of their scene file again, those of the observed time too, up to their scene's end.

    Curves of location and rotation that the user made are replaced; others, such as of scale, stay.

    Args:
        anchors: Anchors of one loaded scene.
        scene: What `source` gave for them.
    """
    for anchor in anchors:
        times = times_of(anchor)
        fcurves.make_own(anchor)
        place = fcurves.place(anchor)
        clear(anchor, place)
        anchor.location, anchor.rotation_quaternion = anchor.r5dgs.pivot, (1.0, 0.0, 0.0, 0.0)
        allowed, reach = physics.key_error(anchor)
        exact = replace(times, t_max=float(scene.t_max))
        keyframes.animate(anchor, scene, anchor.r5dgs.motion_id, exact, allowed / scene.extent, reach)
        physics.reset(anchor)
        physics.sign(anchor, times)
        confidence_tubes.refresh(anchor, times)


def clear(anchor: bpy.types.Object, place: fcurves.Place) -> None:
    """Remove an anchor's curves of location and rotation."""
    curves = place.curves()
    if not curves:
        return
    owned = compat.channels(place.action, place.slot)
    for curve in curves.values():
        owned.remove(curve)


def register():
    """Have a change of an anchor's fields re-extrapolate it."""
    physics.call_on_change(re_extrapolate)


def unregister():
    """Undo `register`."""
    physics.call_on_change(None)
