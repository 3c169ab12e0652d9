"""Conversion of a group's motion to F-curves of its anchor.

In the observed time, playback is a cubic between knots. Bezier keys with the knots' slopes and handles at a third of
the interval reproduce it exactly; fewer keys are used if they stay within the tolerance. Past t_max, keys are fitted to
the motion model within the same tolerance and have another key type. There may be a kink at t_max. A motion too fast
for this gets a key at every frame, and its anchor is marked.
"""

import bpy
import numpy as np

from ...r5dgs_core.motion import cubic_curves, models
from ...r5dgs_core.motion import key_reduction as reduction
from ...r5dgs_core.motion.cubic_curves import Curves, Keys
from ...r5dgs_core.playback import group_curves
from ...r5dgs_core.scene.scene import Scene
from .. import compat
from ..scene import timeline

# Fraction of the scene's extent. Blender may deviate from playback by 1e-5, including its float32 evaluation.
TOLERANCE = group_curves.TOLERANCE
_PER_KNOT = 4  # limit of reduced keys per knot; beyond it, one key per knot takes fewer keys
NEAREST = 0.011  # minimum distance of keys in frames; Blender merges keys closer than 0.01
_INTERVALS = 1 << 17  # limit of key intervals of all objects, so that no file blocks Blender for minutes
OBSERVED_KEY, EXTRAPOLATED_KEY = "KEYFRAME", "EXTREME"


def animate(
    anchor: bpy.types.Object,
    scene: Scene,
    motion_id: int,
    times: timeline.Times,
    tolerance: float,
    reach: float,
) -> None:
    """Keyframe an anchor with the motion of its group; a static group gets no keys.

    Args:
        anchor: Empty at the group's pivot in rotation mode Quaternion, without location or rotation curves.
        scene: Source scene.
        motion_id: Motion group.
        times: Scene times and their frames.
        tolerance: Maximum error of reduced keys at the group's members, as a fraction of the scene's extent.
        reach: Reach of the group, from `group_curves.reaches`.
    """
    if motion_id == 0:
        return
    motion = curves(scene, motion_id, times, tolerance, reach)
    anchor.r5dgs_motion.too_fast = not motion.followed
    location, rotation = motion.location, motion.rotation
    moves, turns = varies(location.values), varies(rotation.values)
    if not (moves or turns):
        return
    fcurves = compat.own_fcurves(anchor, anchor.name)
    if moves:
        pivot = scene.groups[motion_id].home
        placed = Keys(location.times, location.values + pivot, location.left_slopes, location.right_slopes)
        write(fcurves, "location", placed, times)
    if turns:
        write(fcurves, "rotation_quaternion", rotation, times)


def curves(scene: Scene, motion_id: int, times: timeline.Times, tolerance: float, reach: float) -> Curves:
    """Keys of a motion group from the first knot to the end, over scene time.

    Args:
        scene: Source scene.
        motion_id: Motion group.
        times: Scene times and their frames; nothing is extrapolated if the end is not after t_max.
        tolerance: Maximum error of reduced keys at the group's members, as a fraction of the scene's extent.
        reach: Reach of the group, from `group_curves.reaches`.

    Returns:
        Displacement of the anchor and rotation, in the frame of its parent if the group is a part, with a key at t_max
        unless they are constant.
    """
    allowed = tolerance * scene.extent
    observed = _observed(scene, motion_id, allowed, reach)
    if times.t_end <= scene.t_max:
        return observed
    most = intervals_per_object(len(scene.groups))
    sample, model, stop = group_curves.future(scene, motion_id, most)
    return cubic_curves.join(observed, reduced_keys(sample, scene.t_max, times, allowed, reach, most, model, stop))


def intervals_per_object(objects: int) -> int:
    """Maximum number of key intervals per object, passed to `reduced_keys`."""
    return min(max(_INTERVALS // max(objects, 1), reduction.MIN_INTERVALS), reduction.MAX_INTERVALS)


def reduced_keys(
    sample: reduction.Sampler,
    start: float,
    times: timeline.Times,
    allowed: float,
    reach: float,
    most: int,
    model: models.MotionModel,
    stop_time: float | None = None,
) -> Curves:
    """Reduced keys from a scene time to the end.

    Args:
        sample: Poses and slopes at scene times.
        start: First time.
        times: Scene times and their frames.
        allowed: Maximum error of reduced keys at the members, world units.
        reach: Largest distance of a member from the pivot, world units.
        most: Maximum number of intervals between keys, from `intervals_per_object`.
        model: Motion behind the samples since ``start``, whose kinks become keys.
        stop_time: Time since ``start`` at which the motion stops, which becomes a key, too; None if it does not.
    """
    kinks = group_curves.kinks(model, start, times.t_end, stop_time)
    frames = reduction.FrameTimes(times.time(0.0), 1 / times.frames_per_unit)
    nearest = NEAREST / times.frames_per_unit
    return reduction.reduce(sample, start, times.t_end, allowed, reach, kinks, nearest, frames, most)


def _observed(scene: Scene, motion_id: int, allowed: float, radius: float) -> Curves:
    """One key per knot and jump, which is exact, or fewer keys if they stay within the tolerance."""
    exact = group_curves.observed(scene, motion_id)
    times = np.asarray(scene.tracks.times, np.float64)
    jumps = [keys.times[(keys.left_slopes != keys.right_slopes).any(-1)] for keys in (exact.location, exact.rotation)]
    if len(times) < 2 or not _worth_reducing(exact, allowed, radius):
        return exact

    def sample(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        raw, raw_slopes = cubic(exact.rotation, at)
        moved, moved_slopes = cubic(exact.location, at)
        norm = np.linalg.norm(raw, axis=-1, keepdims=True)
        unit = raw / norm
        return unit, moved, (raw_slopes - unit * (unit * raw_slopes).sum(-1, keepdims=True)) / norm, moved_slopes

    most = min(max(_PER_KNOT * len(times), reduction.MIN_INTERVALS), reduction.MAX_INTERVALS)
    fewer = reduction.reduce(sample, float(times[0]), float(times[-1]), allowed, radius, np.union1d(*jumps), most=most)
    if not fewer.followed:
        return exact
    return Curves(
        *(
            some if len(some.times) < len(all_knots.times) else all_knots
            for some, all_knots in ((fewer.location, exact.location), (fewer.rotation, exact.rotation))
        )
    )


def _worth_reducing(exact: Curves, allowed: float, radius: float) -> bool:
    """True if some knot can be removed: the cubic between its neighbours stays within the tolerance.

    Playback has a kink in its second derivative at each knot. If no knot can be removed, other key positions do not
    help.
    """
    for keys, reach in ((exact.location, 1.0), (exact.rotation, 2.0 * radius)):
        if len(keys.times) == 2 or not varies(keys.values):
            return True
        around = [slice(None, -2), slice(2, None)]
        (t0, t1), (v0, v1) = ([a[part] for part in around] for a in (keys.times, keys.values))
        m0, m1 = keys.right_slopes[around[0]], keys.left_slopes[around[1]]
        h = (t1 - t0)[:, None]
        worst = np.zeros(len(t0))
        for u in (0.2, 0.4, 0.6, 0.8):
            truth, _ = cubic(keys, t0 + u * (t1 - t0))
            # To first order, quaternions at distance e move a point at radius r by at most 2 r e.
            missed = cubic_curves.hermite(v0, v1, m0, m1, h, u) - truth
            worst = np.maximum(worst, reach * np.linalg.norm(missed, axis=-1))
        if (worst <= allowed).mean() > 0.05:
            return True
    return False


def cubic(keys: Keys, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values and slopes of the cubic between keys, at times within their range. [S] -> [S, C], [S, C]"""
    k = np.clip(np.searchsorted(keys.times, at, side="right") - 1, 0, len(keys.times) - 2)
    h = (keys.times[k + 1] - keys.times[k])[:, None]
    u = (at - keys.times[k])[:, None] / h
    start, stop, leave, arrive = keys.values[k], keys.values[k + 1], keys.right_slopes[k], keys.left_slopes[k + 1]
    slopes = 6 * (u - u * u) * (stop - start) / h + (1 - 4 * u + 3 * u * u) * leave + (3 * u * u - 2 * u) * arrive
    return cubic_curves.hermite(start, stop, leave, arrive, h, u), slopes


def write(fcurves, data_path: str, curve: Keys, times: timeline.Times) -> None:
    """Write a curve as F-curves with Bezier keys and free handles. A constant component gets one key.

    Args:
        fcurves: Target collection; existing keys of this data path are replaced.
        data_path: "location" or "rotation_quaternion".
        curve: Keys over scene time.
        times: Scene times and their frames.
    """
    bezier = compat.keyframe_enum("interpolation", "BEZIER")
    free = compat.keyframe_enum("handle_left_type", "FREE")
    kinds = {kind: compat.keyframe_enum("type", kind) for kind in (OBSERVED_KEY, EXTRAPOLATED_KEY)}
    frames = times.frame(1.0) - times.frame(0.0)
    for index in range(curve.values.shape[1]):
        keep = slice(None) if varies(curve.values[:, index : index + 1]) else slice(0, 1)
        t, value = curve.times[keep], curve.values[keep, index]
        gaps = np.diff(t)
        before = np.concatenate([gaps[:1], gaps]) if len(gaps) else np.ones(1)
        after = np.concatenate([gaps, gaps[-1:]]) if len(gaps) else np.ones(1)
        frame = times.frame(0.0) + frames * t
        left = np.stack([frame - frames * before / 3, value - curve.left_slopes[keep, index] * before / 3], axis=-1)
        right = np.stack([frame + frames * after / 3, value + curve.right_slopes[keep, index] * after / 3], axis=-1)
        kind = np.where(t > times.t_max + 1e-9, kinds[EXTRAPOLATED_KEY], kinds[OBSERVED_KEY])
        fcurve = fcurves.find(data_path, index=index) or fcurves.new(data_path, index=index)
        points = fcurve.keyframe_points
        for k in range(len(points) - 1, -1, -1):
            points.remove(points[k], fast=True)
        points.add(len(t))
        count = len(t)
        points.foreach_set("interpolation", np.full(count, bezier, np.int32))
        points.foreach_set("handle_left_type", np.full(count, free, np.int32))
        points.foreach_set("handle_right_type", np.full(count, free, np.int32))
        points.foreach_set("type", kind.astype(np.int32))
        points.foreach_set("co", np.stack([frame, value], axis=-1).astype(np.float32).ravel())
        points.foreach_set("handle_left", left.astype(np.float32).ravel())
        points.foreach_set("handle_right", right.astype(np.float32).ravel())
        fcurve.update()


def varies(values: np.ndarray) -> bool:
    """True if a curve is not constant. [K, C]"""
    return bool((values != values[:1]).any())
