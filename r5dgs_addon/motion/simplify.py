"""Key reduction of an anchor within a given tolerance of its current curves, for manual editing."""

import bpy
import numpy as np
from bpy.props import FloatProperty

from ...r5dgs_core import errors
from ...r5dgs_core.motion import bezier, cubic_curves, rotations
from ...r5dgs_core.motion import key_reduction as reduction
from .. import compat
from ..scene import timeline
from . import curve_place, extrapolate, fcurves, keyframes, physics

_FRAMES = reduction.FrameTimes(0.0, 1.0)  # the curves' times are frames
# Slopes before and after a key form no kink if they differ by less than this share of the allowed error, divided by the
# duration of the shorter segment.
_SLOPE_TOLERANCE = 0.01
# Setting of operators that reduce keys.
TOLERANCE = FloatProperty(
    name="Tolerance",
    description="Maximum displacement of any point as a fraction of the object's size",
    default=1e-3,
    min=1e-6,
    max=0.5,
    precision=5,
)


def simplify(anchors: list[bpy.types.Object], share: float) -> tuple[int, int]:
    """Rewrite location and rotation of anchors with as few keys as a tolerance permits, also for later extrapolation.

    The first and the last key, the last observed time and kinks stay exact. Other channels are kept.

    Args:
        anchors: Anchors of loaded scenes.
        share: Maximum displacement of any point, as a fraction of its object's size.

    Returns:
        Number of keys before and after.

    Raises:
        ConfigError: Curves of an anchor are not smooth or cannot be written; nothing was changed.
    """
    plans = [(anchor, *_plan(anchor, share * physics.size(anchor))) for anchor in anchors]
    before = key_count(anchors)
    for anchor, times, allowed, written in plans:
        if written:
            curve_place.make_own(anchor)
            owned = compat.own_fcurves(anchor, anchor.name)
            for path, keys in written.items():
                keyframes.write(owned, path, _over_time(keys, times), times)
        physics.set_allowed_error(anchor, allowed)
        physics.store_digests(anchor, times)
    return before, key_count(anchors)


def key_count(anchors: list[bpy.types.Object]) -> int:
    """Total number of location and rotation keys of anchors."""
    curves = [curve for anchor in anchors for curve in curve_place.find(anchor).curves().values()]
    return sum(len(curve.keyframe_points) for curve in curves)


def _plan(anchor: bpy.types.Object, allowed: float) -> tuple[timeline.Times, float, dict[str, cubic_curves.Keys]]:
    """Times, allowed error and new keys over frames of an anchor; no keys if nothing can be removed."""
    times, place = extrapolate.times_of(anchor), curve_place.find(anchor)
    if place.strip is not None:
        raise errors.ConfigError(f"{anchor.name}: its action is in the NLA; make it active again first")
    curves = {name: curve for name, curve in place.curves().items() if len(curve.keyframe_points)}
    parts = {name: _segments(anchor.name, curve) for name, curve in curves.items()}
    if all(len(curve.keyframe_points) == 1 for curve in curves.values()):
        return times, allowed, {}
    _, reach = physics.key_error(anchor)
    joined = _reduced(anchor, parts, times.frame(times.t_max), allowed, reach)
    found = {"location": joined.location, "rotation_quaternion": joined.rotation}
    return times, allowed, {path: keys for path, keys in found.items() if any(name == path for name, _ in parts)}


def _segments(name: str, curve: bpy.types.FCurve) -> np.ndarray:
    """Segments of a curve, or one degenerate segment if it has one key. [K, 4, 2]"""
    points = fcurves.KeyArrays(curve)
    co, left, right = (values.astype(np.float64) for values in (points.co, points.left, points.right))
    if len(co) == 1:
        return np.repeat(co[:, None], 4, axis=1)
    result = np.stack([co[:-1], right[:-1], left[1:], co[1:]], axis=1)
    for k, point in enumerate(list(curve.keyframe_points)[:-1]):
        if point.interpolation == "LINEAR":
            result[k] = bezier.line(co[k], co[k + 1])
        elif point.interpolation != "BEZIER" and co[k, 1] != co[k + 1, 1]:
            raise errors.ConfigError(
                f"{name}: {curve.data_path}[{curve.array_index}] has the interpolation {point.interpolation.title()} "
                f"at frame {co[k, 0]:g}; make it Bezier first"
            )
    return result


def _reduced(
    anchor: bpy.types.Object, parts: dict[tuple[str, int], np.ndarray], last: float, allowed: float, reach: float
) -> cubic_curves.Curves:
    """Reduced keys over frames, computed between kinks and joined there."""
    start = min(float(part[0, 0, 0]) for part in parts.values())
    stop = max(float(part[-1, 3, 0]) for part in parts.values())
    kinks = [kink for name, part in parts.items() for kink in _kinks(part, allowed, name[0], reach)]
    held = [end for part in parts.values() for end in (float(part[0, 0, 0]), float(part[-1, 3, 0]))]
    cuts = np.unique([start, stop, *(cut for cut in (*kinks, *held, last) if start < cut < stop)])
    cuts = cuts[np.concatenate([[True], np.diff(cuts) > fcurves.FRAME_TOLERANCE])]
    joined = None
    for a, b in zip(cuts[:-1], cuts[1:], strict=True):
        sample = _sampler(anchor, parts, a, b)
        some = reduction.reduce(sample, float(a), float(b), allowed, reach, nearest=keyframes.NEAREST, frames=_FRAMES)
        joined = some if joined is None else cubic_curves.join(joined, some)
    assert joined is not None
    return joined


def _kinks(part: np.ndarray, allowed: float, path: str, reach: float) -> list[float]:
    """Frames of discontinuous slope."""
    if len(part) < 2:
        return []
    scale = 1.0 if path == "location" else max(2.0 * reach, 1e-12)
    arrive, leave = part[:-1, 3] - part[:-1, 2], part[1:, 1] - part[1:, 0]
    spans = np.minimum(part[:-1, 3, 0] - part[:-1, 0, 0], part[1:, 3, 0] - part[1:, 0, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        bend = np.abs(arrive[:, 1] / arrive[:, 0] - leave[:, 1] / leave[:, 0]) * spans * scale
    return part[1:, 0, 0][~(bend <= _SLOPE_TOLERANCE * allowed)].tolist()


def _sampler(
    anchor: bpy.types.Object, parts: dict[tuple[str, int], np.ndarray], start: float, stop: float
) -> reduction.Sampler:
    """Poses and slopes between two frames without a kink, as Blender evaluates the curves."""

    def column(path: str, index: int, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        part = parts.get((path, index))
        value = getattr(anchor, path)[index] if part is None else None
        middle = 0.5 * (start + stop)
        if part is not None and not part[0, 0, 0] <= middle <= part[-1, 3, 0]:  # constant before and after its keys
            value = part[0, 0, 1] if middle < part[0, 0, 0] else part[-1, 3, 1]
        if value is not None or part is None:
            return np.full(len(at), value), np.zeros(len(at))
        inside = part[
            (part[:, 0, 0] < stop - fcurves.FRAME_TOLERANCE) & (part[:, 3, 0] > start + fcurves.FRAME_TOLERANCE)
        ]
        return bezier.evaluate(inside, np.clip(at, inside[0, 0, 0], inside[-1, 3, 0]))

    def sample(at: np.ndarray) -> reduction.Samples:
        moved, moved_slopes = (
            np.stack(x, axis=-1) for x in zip(*(column("location", i, at) for i in range(3)), strict=True)
        )
        raw, raw_slopes = (
            np.stack(x, axis=-1) for x in zip(*(column("rotation_quaternion", i, at) for i in range(4)), strict=True)
        )
        norm = np.linalg.norm(raw, axis=-1, keepdims=True)
        unit = rotations.normalize(raw)
        return unit, moved, (raw_slopes - unit * (unit * raw_slopes).sum(-1, keepdims=True)) / norm, moved_slopes

    return sample


def _over_time(keys: cubic_curves.Keys, times: timeline.Times) -> cubic_curves.Keys:
    """Convert keys over frames to keys over scene time."""
    per = times.frames_per_unit
    return cubic_curves.Keys(times.time(keys.times), keys.values, keys.left_slopes * per, keys.right_slopes * per)
