"""Keys of an anchor from t_max on and its motion, as a text from which both are restored exactly."""

import json
from typing import Any

import bpy
import numpy as np

from ...r5dgs_core.motion import models
from .. import compat
from ..scene import timeline
from . import confidence_tubes, curve_place, fcurves, motion_fields

_POINTS = ("co", "handle_left", "handle_right")
_ENUMS = ("interpolation", "easing", "handle_left_type", "handle_right_type", "type")
_STATE = ("taken", "kind", "written", "written_motion", "too_fast")
_FIELDS = (*models.FIELDS, "pivot")


def keep(anchor: bpy.types.Object, times: timeline.Times) -> str:
    """Return the keys from t_max on of an anchor's location and rotation, and its motion. Raises ConfigError."""
    state, place = anchor.r5dgs_motion, curve_place.find(anchor)
    kept: dict[str, Any] = {name: getattr(state, name) for name in _STATE}
    kept["leader"] = None if state.leader is None else state.leader.name
    kept["fields"] = {name: _plain(getattr(state, f"stored_{name}")) for name in _FIELDS}
    frame = times.frame(times.t_max)
    kept["curves"] = [[*key, _keys(curve, frame)] for key, curve in place.curves().items()]
    return json.dumps(kept)


def restore(anchor: bpy.types.Object, text: str, times: timeline.Times) -> None:
    """Restore what `keep` returned; earlier keys stay. Raises ConfigError if the curves cannot be written."""
    kept, state = json.loads(text), anchor.r5dgs_motion
    curve_place.make_own(anchor)
    place = curve_place.find(anchor)
    curves = place.curves()
    stored = {(path, index): keys for path, index, keys in kept["curves"]}
    for key, curve in curves.items():
        if key not in stored:
            compat.channels(place.action, place.slot).remove(curve)
    for (path, index), keys in stored.items():
        curve = curves.get((path, index)) or compat.own_fcurves(anchor, anchor.name).new(path, index=index)
        _write(curve, keys)
    with motion_fields.not_at_once(state):
        for name, value in kept["fields"].items():
            setattr(state, f"stored_{name}", value)
        for name in _STATE:
            setattr(state, name, kept[name])
        state.leader = bpy.data.objects.get(kept["leader"] or "")
    confidence_tubes.refresh(anchor, times)


def _plain(value: Any) -> Any:
    return list(value) if hasattr(value, "__len__") else value


def _keys(curve: bpy.types.FCurve, frame: float) -> dict[str, list]:
    """Keys of a curve from the last one at or before a frame on, or all if none is at the frame."""
    points = fcurves.KeyArrays(curve)
    first = points.last(frame)
    first = first if first >= 0 and points.at(first, frame) else 0
    places = zip(_POINTS, (points.co, points.left, points.right), strict=True)
    enums = zip(_ENUMS, fcurves.enums(curve, _ENUMS), strict=True)
    return {name: values[first:].ravel().tolist() for name, values in (*places, *enums)}


def _write(curve: bpy.types.FCurve, keys: dict[str, list]) -> None:
    """Replace the keys of a curve from the first of ``keys`` on."""
    points = curve.keyframe_points
    before = fcurves.KeyArrays(curve)
    first = keys["co"][0] if keys["co"] else np.inf
    kept = int(np.searchsorted(before.co[:, 0], first - fcurves.FRAME_TOLERANCE))
    for k in range(len(points) - 1, kept - 1, -1):
        points.remove(points[k], fast=True)
    points.add(len(keys["type"]))
    for name in (*_ENUMS, *_POINTS):
        kind, width = (np.float32, 2) if name in _POINTS else (np.int32, 1)
        values = np.empty(width * len(points), kind)
        points.foreach_get(name, values)
        values[width * kept :] = keys[name]
        points.foreach_set(name, values)
    curve.update()
