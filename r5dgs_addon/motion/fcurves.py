"""Reading of an anchor's F-curves, including the user's edits, and replacement of the keys after a frame.

Frames are those of the action. If an NLA strip plays the action at another time or speed, it plays the new keys
likewise.

Up to the given frame, a curve is unchanged: keys, handles, easing. If there is no key at the frame, the segment across
it is split there without changing its shape.
"""

import hashlib
from collections.abc import Sequence

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.motion import bezier
from ...r5dgs_core.motion.cubic_curves import Keys
from .. import compat
from ..scene import timeline
from . import keyframes
from .curve_place import COMPONENTS, Place

FRAME_TOLERANCE = 1e-3  # tolerance in frames for a key to count as being at a frame
_CUT = ("BEZIER", "LINEAR", "CONSTANT")  # interpolations of segments that can be split


def pose_at(anchor: bpy.types.Object, where: Place, frame: float) -> tuple[np.ndarray, np.ndarray]:
    """Location [3] and unnormalised quaternion [4] of an anchor's keys at a frame, without F-curve modifiers."""
    curves = {name: curve for name, curve in where.curves().items() if len(curve.keyframe_points)}
    values = []
    for path, count in COMPONENTS:
        still = getattr(anchor, path)
        values.append(
            np.array(
                [
                    _value(anchor.name, curves[path, index], frame) if (path, index) in curves else still[index]
                    for index in range(count)
                ],
                np.float64,
            )
        )
    return values[0], values[1]


def _value(name: str, curve: bpy.types.FCurve, frame: float) -> float:
    points = KeyArrays(curve)
    k = points.last(frame)
    if k >= 0 and points.at(k, frame):
        return float(points.co[k, 1])
    if k < 0:
        return float(points.co[0, 1])
    return float(_cut(name, curve, points, k, frame)[-1, 3, 1])


class KeyArrays:
    """Keys of a curve as arrays: co, left, right [K, 2] float32."""

    def __init__(self, curve: bpy.types.FCurve):
        points = curve.keyframe_points
        self.count = len(points)
        self.co, self.left, self.right = (self._get(points, field) for field in ("co", "handle_left", "handle_right"))

    def _get(self, points, field: str) -> np.ndarray:
        values = np.empty(2 * self.count, np.float32)
        points.foreach_get(field, values)
        return values.reshape(-1, 2)

    def last(self, frame: float) -> int:
        """Index of the last key at or before a frame, or -1."""
        return int(np.searchsorted(self.co[:, 0], frame + FRAME_TOLERANCE, side="right")) - 1

    def at(self, k: int, frame: float) -> bool:
        return abs(float(self.co[k, 0]) - frame) <= FRAME_TOLERANCE


def enums(curve: bpy.types.FCurve, names: Sequence[str]) -> np.ndarray:
    """Enumerations of the keys as Blender's integers. [len(names), K] int32"""
    values = np.empty((len(names), len(curve.keyframe_points)), np.int32)
    for name, row in zip(names, values, strict=True):
        curve.keyframe_points.foreach_get(name, row)
    return values


def _cut(name: str, curve: bpy.types.FCurve, points: KeyArrays, k: int, frame: float) -> np.ndarray:
    """Split the segment that starts with key k at a frame; returns the one or two segments before it. [n, 4, 2]

    If k is the last key, the returned segment follows the curve's extrapolation.
    """
    start = points.co[k].astype(np.float64)
    if k + 1 == points.count:
        rise = 0.0
        if curve.extrapolation == "LINEAR":
            run, up = start - points.left[k]
            rise = float(up / run) if run > 0 else 0.0
        end = start + (frame - start[0]) * np.array([1.0, rise])
        return bezier.line(start, end)[None]
    stop = points.co[k + 1].astype(np.float64)
    kind = curve.keyframe_points[k].interpolation
    if kind not in _CUT:
        raise errors.ConfigError(
            f"{name}: {curve.data_path}[{curve.array_index}] has the interpolation {kind.title()} across the last "
            f"observed frame; set a key at frame {frame:g} first, or make it Bezier"
        )
    if kind == "BEZIER":
        return bezier.split(np.stack([start, points.right[k], points.left[k + 1], stop]).astype(np.float64), frame)[0]
    if kind == "CONSTANT":
        stop = np.array([stop[0], start[1]])
    return bezier.split(bezier.line(start, stop), frame)[0]


def replace_after(anchor: bpy.types.Object, where: Place, frame: float, tails: dict[str, Keys]) -> None:
    """Replace an anchor's keys after a frame; the curves are unchanged up to it.

    Args:
        anchor: Anchor.
        where: Location of its curves, from `curve_place.find`.
        frame: Frame after which keys are replaced.
        tails: Keys over frames by data path; the first is at ``frame`` and continues the existing curve. Other paths
            hold their value from ``frame`` on.
    """
    curves = where.curves()
    for path, count in COMPONENTS:
        tail = tails.get(path)
        changes = tail is not None and keyframes.varies(tail.values)
        if changes and not all((path, index) in curves for index in range(count)):
            owned = compat.own_fcurves(anchor, anchor.name) if where.strip is None else None
            if owned is None:
                owned = compat.channels(where.action, where.slot)
            for index in range(count):
                if (path, index) not in curves:
                    curves[path, index] = owned.new(path, index=index)
                    _start(curves[path, index], frame, float(getattr(anchor, path)[index]))
        for index in range(count):
            if (path, index) in curves:
                component = None if not changes else _component(tail, index)
                _replace(anchor, curves[path, index], frame, component)
    if where.strip is not None:
        _stretch(where.strip)


def _component(keys: Keys, index: int) -> Keys | None:
    """One component of keys, or None if it is constant."""
    column = slice(index, index + 1)
    values = keys.values[:, column]
    if not keyframes.varies(values):
        return None
    return Keys(keys.times, values, keys.left_slopes[:, column], keys.right_slopes[:, column])


def _start(curve: bpy.types.FCurve, frame: float, value: float) -> None:
    """Add the first key to a new curve."""
    curve.keyframe_points.add(1)
    _fill(curve, 0, np.array([[frame, value]]), np.zeros((1, 1)), np.zeros((1, 1)), np.ones(1), np.ones(1), False)
    curve.update()


def _replace(anchor: bpy.types.Object, curve: bpy.types.FCurve, frame: float, tail: Keys | None) -> None:
    before = KeyArrays(curve)
    keep = before.last(frame) + 1
    points = curve.keyframe_points
    if keep == 0:  # the user removed all earlier keys; hold the value at the frame
        still = getattr(anchor, curve.data_path)[curve.array_index]  # used if the curve has no keys
        value = float(before.co[0, 1]) if before.count else still
        _shorten(curve, 0)
        _start(curve, frame, value)
        before, keep = KeyArrays(curve), 1
    elif not before.at(keep - 1, frame) and (tail is not None or keep < before.count):
        parts = _cut(anchor.name, curve, before, keep - 1, frame)
        bends = curve.keyframe_points[keep - 1].interpolation == "BEZIER" and keep < before.count
        left_of_last = before.left[keep - 1].copy()
        _shorten(curve, keep)
        for part in parts:
            points.add(1)
            _fill(curve, keep, part[3:], np.zeros((1, 1)), np.zeros((1, 1)), np.ones(1), np.ones(1), False)
            points[keep].handle_left = part[2]
            if bends:
                _free(points[keep - 1], left_of_last, part[1])
            left_of_last = part[2]
            keep += 1
        before = KeyArrays(curve)
    _shorten(curve, keep)
    if tail is not None:
        gaps = np.diff(tail.times)
        after = np.concatenate([gaps, gaps[-1:]])
        joint = points[keep - 1]
        joint.interpolation = "BEZIER"
        reach = np.array([gaps[0] / 3, tail.right_slopes[0, 0] * gaps[0] / 3])
        _free(joint, before.left[keep - 1], before.co[keep - 1] + reach)
        points.add(len(tail.times) - 1)
        co = np.stack([tail.times[1:], tail.values[1:, 0]], axis=-1)
        _fill(curve, keep, co, tail.left_slopes[1:], tail.right_slopes[1:], gaps, after[1:], True)
    curve.update()
    _restore(curve, before, keep)


def _free(point: bpy.types.Keyframe, left: np.ndarray, right: np.ndarray) -> None:
    """Set both handles of a key."""
    point.handle_left_type = point.handle_right_type = "FREE"
    point.handle_left, point.handle_right = left, right


def _shorten(curve: bpy.types.FCurve, keep: int) -> None:
    points = curve.keyframe_points
    for k in range(len(points) - 1, keep - 1, -1):
        points.remove(points[k], fast=True)


def _fill(
    curve: bpy.types.FCurve,
    start: int,
    co: np.ndarray,
    left_slopes: np.ndarray,
    right_slopes: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    extrapolated: bool,
) -> None:
    """Overwrite the keys of a curve from ``start`` on: points [n, 2], slopes [n, 1], gaps on both sides [n]."""
    points = curve.keyframe_points
    reach_left = np.stack([before / 3, left_slopes[:, 0] * before / 3], axis=-1)
    reach_right = np.stack([after / 3, right_slopes[:, 0] * after / 3], axis=-1)
    for field, values in (("co", co), ("handle_left", co - reach_left), ("handle_right", co + reach_right)):
        whole = np.empty(2 * len(points), np.float32)
        points.foreach_get(field, whole)
        whole[2 * start :] = np.asarray(values, np.float32).ravel()
        points.foreach_set(field, whole)
    kind = keyframes.EXTRAPOLATED_KEY if extrapolated else keyframes.OBSERVED_KEY
    enums = {"interpolation": "BEZIER", "handle_left_type": "FREE", "handle_right_type": "FREE", "type": kind}
    for field, item in enums.items():
        whole = np.empty(len(points), np.int32)
        points.foreach_get(field, whole)
        whole[start:] = compat.keyframe_enum(field, item)
        points.foreach_set(field, whole)


def _restore(curve: bpy.types.FCurve, before: KeyArrays, keep: int) -> None:
    """Restore handles that Blender recomputed (automatic handles with changed neighbours)."""
    after = KeyArrays(curve)
    for k in range(keep):
        last = k == keep - 1
        right = after.right[k] if last else before.right[k]
        if (after.left[k] != before.left[k]).any() or (after.right[k] != right).any():
            _free(curve.keyframe_points[k], before.left[k], right)


def _stretch(strip: bpy.types.NlaStrip) -> None:
    """Extend an NLA strip to its whole action, unless it is a retiming, which covers all frames."""
    if strip.use_animated_time:
        return
    last = max(
        (point.co[0] for curve in Place(strip.action, compat.slot_of(strip)).curves().values()
         for point in list(curve.keyframe_points)[-1:]),
        default=strip.action_frame_end,
    )  # fmt: skip
    strip.action_frame_end = max(last, strip.action_frame_start + 1)
    length = (strip.action_frame_end - strip.action_frame_start) * strip.scale * strip.repeat
    strip.frame_end = strip.frame_start + length


def digest(where: Place, frame: float) -> str:
    """Digest of all keys after a frame, for detecting manual edits."""
    found = hashlib.sha1(usedforsecurity=False)
    for (path, index), curve in sorted(where.curves().items(), key=lambda item: item[0]):
        points = KeyArrays(curve)
        later = slice(points.last(frame) + 1, None)
        if len(points.co[later]):
            found.update(f"{path}{index}".encode())
            for part in (points.co, points.left, points.right):
                found.update(np.ascontiguousarray(part[later]).tobytes())
    return found.hexdigest()


def frames(keys: Keys, times: timeline.Times) -> Keys:
    """Convert keys over scene time to keys over frames."""
    per = times.frames_per_unit
    return Keys(times.frame(0.0) + per * keys.times, keys.values, keys.left_slopes / per, keys.right_slopes / per)
