"""Bake of simulated rigid bodies back to keys of their anchors."""

import bpy
import numpy as np
from mathutils import Matrix

from ...r5dgs_core import errors
from ...r5dgs_core.motion import cubic_curves, key_reduction, rotations
from . import confidence_tubes, curve_place, extrapolate, fcurves, hand_over, keyframes, physics

_FRAMES = key_reduction.FrameTimes(0.0, 1.0)  # the curves' times are frames


def bake(context: bpy.types.Context, share: float) -> list[bpy.types.Object]:
    """Simulate up to the end of the frame range, write the poses to keys, and remove the proxies.

    Keys up to the release are unchanged. Those after it follow the poses of all frames; shadows follow their object.

    Args:
        context: Context whose Blender scene has the proxies.
        share: Maximum displacement of any point from the simulation, as a fraction of its object's size.

    Returns:
        The anchors that were written.

    Raises:
        ConfigError: There are no proxies, the frame range ends before their release, or an anchor cannot be written;
            nothing was changed.
    """
    scene = context.scene
    proxies = hand_over.proxies_of(scene)
    if proxies is None:
        raise errors.ConfigError("no object is a rigid body: hand objects over first")
    release, end = int(proxies[hand_over.FRAME]), scene.frame_end
    if end <= release:
        raise errors.ConfigError(f"the frame range ends at {end}; set an end after the release at {release}")
    anchors = hand_over.anchors_of(proxies)
    shadows = extrapolate.followers(anchors)
    starts = {}
    for anchor in (*anchors, *shadows):
        place = curve_place.find(anchor)
        if place.strip is not None:
            raise errors.ConfigError(f"{anchor.name}: its action is in the NLA; make it active again first")
        starts[anchor] = fcurves.pose_at(anchor, place, release)
    poses = _simulated(scene, anchors, release, end)
    hand_over.remove_proxies(context, proxies)
    tails = {anchor: _tails(anchor, release, poses[:, k], starts[anchor], share) for k, anchor in enumerate(anchors)}
    for shadow in shadows:
        state = shadow.r5dgs_motion
        tails[shadow] = {"location": _following(tails[state.leader]["location"], state, starts[shadow][0])}
    for anchor, keys in tails.items():
        curve_place.make_own(anchor)
        fcurves.replace_after(anchor, curve_place.find(anchor), release, keys)
        times = extrapolate.times_of(anchor)
        extrapolate.scene_of(anchor).r5dgs.t_end = max(times.t_end, times.time(end))
        confidence_tubes.refresh(anchor, extrapolate.times_of(anchor))
    context.view_layer.update()
    return anchors


def _simulated(scene: bpy.types.Scene, anchors: list[bpy.types.Object], release: int, end: int) -> np.ndarray:
    """Poses of anchors relative to their parents at the frames from the release on. [F, A, 4, 4]"""
    now, subframe = scene.frame_current, scene.frame_subframe
    start = release
    if scene.rigidbody_world is not None:
        cache = scene.rigidbody_world.point_cache
        start, cache.frame_end = cache.frame_start, max(cache.frame_end, end)  # Bullet stops at the end of its cache
    found = []
    try:
        for frame in range(min(start, release), end + 1):  # Bullet simulates frame after frame
            scene.frame_set(frame)
            if frame >= release:
                found.append([np.array(_frame_of(anchor).inverted() @ anchor.matrix_world) for anchor in anchors])
    finally:
        scene.frame_set(now, subframe=subframe)
    return np.array(found)


def _frame_of(anchor: bpy.types.Object) -> Matrix:
    """Matrix to the world from the space of an anchor's own location and rotation."""
    parent = anchor.parent
    return Matrix() if parent is None else parent.matrix_world @ anchor.matrix_parent_inverse


def _tails(
    anchor: bpy.types.Object,
    release: int,
    matrices: np.ndarray,
    start: tuple[np.ndarray, np.ndarray],
    share: float,
) -> dict[str, cubic_curves.Keys]:
    """Keys over frames by data path; the first continues the existing curves, whose pose is ``start``."""
    frames = release + np.arange(len(matrices), dtype=np.float64)
    own = rotations.conjugate(rotations.normalize(np.array(anchor.delta_rotation_quaternion, np.float64)))
    places = matrices[:, :3, 3] - np.array(anchor.delta_location)
    quats = np.array([Matrix(matrix).to_quaternion() for matrix in matrices], np.float64)
    quats = rotations.multiply(own, rotations.normalize(quats))
    norm = np.linalg.norm(start[1])
    places[0], quats[0] = start[0], start[1] / norm
    quats = rotations.make_continuous(quats)
    dense = [_dense(frames, values) for values in (places, quats)]

    def sample(at: np.ndarray) -> key_reduction.Samples:
        moved, slopes = keyframes.cubic(dense[0], at)
        turned, turning = keyframes.cubic(dense[1], at)
        return rotations.normalize(turned), moved, turning, slopes

    allowed, reach = share * physics.size(anchor), physics.key_error(anchor)[1]
    few = key_reduction.reduce(sample, frames[0], frames[-1], allowed, reach, nearest=keyframes.NEAREST, frames=_FRAMES)
    turn = few.rotation
    scaled = cubic_curves.Keys(
        turn.times, *(norm * part for part in (turn.values, turn.left_slopes, turn.right_slopes))
    )
    return {"location": few.location, "rotation_quaternion": scaled}


def _following(leader: cubic_curves.Keys, state: bpy.types.PropertyGroup, place: np.ndarray) -> cubic_curves.Keys:
    """Location keys of an anchor that follows another one, from its place at the release. [3]"""
    follow = physics.follow_matrix(state).T
    moved = place + (leader.values - leader.values[0]) @ follow
    return cubic_curves.Keys(leader.times, moved, leader.left_slopes @ follow, leader.right_slopes @ follow)


def _dense(frames: np.ndarray, values: np.ndarray) -> cubic_curves.Keys:
    slopes = cubic_curves.slopes(frames, values)
    return cubic_curves.Keys(frames, values, slopes, slopes)
