"""Retiming of objects by a curve: speed, hold, reverse and loops, by an NLA strip with animated time."""

from collections.abc import Iterable

import bpy

from ...r5dgs_core import errors
from .. import compat
from ..scene import loaded_scenes, point_clouds, presence_keys, retiming, timeline
from . import curve_place, duplicate_delete, exact_mode, extrapolate

NAME = "R5DGS Retiming"
KINDS = (
    ("SPEED", "Speed", "Play slower or faster from the start"),
    ("HOLD", "Hold", "Stop at the current frame for a number of frames, then go on"),
    ("REVERSE", "Reverse", "Play from the last frame to the first"),
    ("LOOP", "Loop", "Repeat the motion from the start"),
    ("PING_PONG", "Ping-Pong", "Repeat the motion forward and backward"),
    ("CURVE", "Own Curve", "Play as before; edit the keys of the curve in the Graph Editor"),
    ("ACTIVE", "Copy from Active", "Use the curve of the active object"),
    ("NONE", "Original", "Remove the retiming"),
)
WHICH = (
    ("SELECTED", "Selected Objects", "The selected objects and their shadows"),
    ("SCENE", "Whole Scene", "All objects of the active scene"),
)


def anchors(context: bpy.types.Context, collection: bpy.types.Collection, which: str) -> list[bpy.types.Object]:
    """Anchors to retime: those with a motion, or with points that bend, enter or leave.

    Args:
        context: Context with the selected objects.
        collection: Active scene.
        which: Key of `WHICH`.
    """
    if which == "SCENE":
        found = loaded_scenes.members(collection, "ANCHOR")
    else:
        chosen = [duplicate_delete.anchor_of(obj) for obj in context.selected_objects]
        own = list(dict.fromkeys(anchor for anchor in chosen if anchor is not None))
        found = [*own, *extrapolate.followers(own)]
    return [anchor for anchor in found if _moves(anchor)]


def _moves(anchor: bpy.types.Object) -> bool:
    animation = anchor.animation_data
    if animation is not None and (animation.action is not None or len(animation.nla_tracks)):
        return True
    bound = point_clouds.BIND + "position"
    clouds = [one for one in duplicate_delete.clouds_of(anchor) if one.type == "POINTCLOUD"]
    return any(one.data.attributes.get(bound) is not None or presence_keys.is_keyed(one) for one in clouds)


def _keyed_clouds(anchor: bpy.types.Object) -> list[tuple[bpy.types.Object, curve_place.Place]]:
    """Point clouds of an anchor that enter or leave, with the location of their keys."""
    found = [cloud for cloud in duplicate_delete.clouds_of(anchor) if presence_keys.is_keyed(cloud)]
    return [(one, curve_place.Place(one.animation_data.action, compat.slot_of(one.animation_data))) for one in found]


def keys(kind: str, first: float, last: float, frame: float, speed: float, hold: float) -> list[tuple[float, float]]:
    """Keys of a retiming: frames, and the frames of the motion that they show.

    Args:
        kind: Key of `KINDS` with a curve of its own.
        first: First frame of the motion.
        last: Last frame of the motion.
        frame: Current frame.
        speed: Speed relative to the original, above 0.
        hold: Number of frames to hold.
    """
    if kind == "SPEED":
        return [(first, first), (first + (last - first) / speed, last)]
    if kind == "HOLD":
        frame = min(max(frame, first), last)
        return [(first, first), (frame, frame), (frame + hold, frame), (last + hold, last)]
    if kind == "REVERSE":
        return [(first, last), (last, first)]
    if kind == "PING_PONG":
        return [(first, first), (last, last), (2 * last - first, first)]
    return [(first, first), (last, last)]


def apply(
    context: bpy.types.Context,
    collection: bpy.types.Collection,
    wanted: Iterable[bpy.types.Object],
    kind: str,
    *,
    speed: float = 1.0,
    hold: float = 0.0,
) -> None:
    """Retime anchors. Their keys stay as they are.

    Args:
        context: Context with the current frame and the active object.
        collection: Loaded scene of the anchors.
        wanted: Anchors.
        kind: Key of `KINDS`.
        speed: As in `keys`.
        hold: As in `keys`.

    Raises:
        ConfigError: An anchor cannot be retimed, or the active object has no curve to copy; nothing is changed.
    """
    wanted = list(wanted)
    places = [curve_place.find(anchor) for anchor in wanted]
    for anchor, place in zip(wanted, places, strict=True):
        if place.strip is not None and not place.strip.use_animated_time:
            raise errors.ConfigError(
                f"{anchor.name}: its motion is an NLA strip already; make its action the active one first"
            )
    times = timeline.of_collection(collection)
    first, last = times.frame(times.t_start), times.frame(times.t_end)
    copied = _copied(context) if kind == "ACTIVE" else None
    made = keys(kind, first, max(last, first + 1), context.scene.frame_current_final, speed, hold)
    clouds = [cloud for anchor in wanted for cloud in _keyed_clouds(anchor)]
    for obj, place in (*zip(wanted, places, strict=True), *clouds):
        obj.update_tag(refresh={"TIME"})
        if kind == "NONE":
            _remove(obj)
            continue
        strip = retiming.strip_of(obj) or _new_strip(obj, place)
        curve = strip.fcurves.find("strip_time")
        _write(
            curve,
            made if copied is None else copied[0],
            (kind in ("LOOP", "PING_PONG") if copied is None else copied[1]),
        )
    context.view_layer.update()
    exact_mode.refresh()


def _copied(context: bpy.types.Context) -> tuple[list[tuple[float, float]], bool]:
    """Keys of the active object's retiming, and True if it repeats."""
    active = duplicate_delete.anchor_of(context.view_layer.objects.active)
    strip = retiming.strip_of(active)
    if strip is None:
        raise errors.ConfigError("retime: expected an active object with a retiming, found none; retime it first")
    curve = retiming.curve_of(strip)
    return [tuple(point.co) for point in curve.keyframe_points], any(m.type == "CYCLES" for m in curve.modifiers)


def _new_strip(obj: bpy.types.Object, place: curve_place.Place) -> bpy.types.NlaStrip:
    """Turn the action of an object into a strip with animated time that covers all frames."""
    animation = obj.animation_data_create()
    track = animation.nla_tracks.new()
    track.name = NAME
    action = place.action or bpy.data.actions.new(obj.name)
    animation.action = None
    strip = track.strips.new(NAME, 1, action)
    compat.choose_slot(strip, place.slot)
    strip.use_sync_length, strip.use_animated_time = False, True
    strip.frame_start, strip.frame_end = -timeline.LAST_FRAME, timeline.LAST_FRAME
    return strip


def _write(curve: bpy.types.FCurve, made: list[tuple[float, float]], repeats: bool) -> None:
    """Replace the keys of a curve by linear ones."""
    for modifier in list(curve.modifiers):
        curve.modifiers.remove(modifier)
    points = curve.keyframe_points
    for k in range(len(points) - 1, -1, -1):
        points.remove(points[k], fast=True)
    for frame, value in made:
        points.insert(frame, value, options={"FAST"}).interpolation = "LINEAR"
    curve.update()
    if repeats:
        curve.modifiers.new("CYCLES")


def _remove(obj: bpy.types.Object) -> None:
    """Make the action of a retimed object its active one again."""
    strip = retiming.strip_of(obj)
    if strip is None:
        return
    animation, action, slot = obj.animation_data, strip.action, compat.slot_of(strip)
    track = next(one for one in animation.nla_tracks if strip.name in one.strips and one.strips[strip.name] == strip)
    animation.nla_tracks.remove(track)
    if curve_place.Place(action, slot).curves() or len(compat.channels(action, slot)):
        compat.play(obj, action, slot)
    elif not action.users:
        bpy.data.actions.remove(action)
