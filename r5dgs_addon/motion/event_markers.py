"""Timeline markers of observed events, such as "ball: impact".

A marker names the loaded scene and the motion group that it belongs to, so that it follows renamed objects and is
removed with the scene, while markers of users stay.
"""

import contextlib
import re
import threading
import uuid
from collections.abc import Collection

import bpy
from bpy.app.handlers import persistent

from ..scene import loaded_scenes, timeline
from . import physics

SCENE = "r5dgs_scene"  # custom property of markers and of loaded scenes: id of the loaded scene
GROUP = "r5dgs_group"  # the same, of markers only: motion group


def show(scene: bpy.types.Scene, collection: bpy.types.Collection) -> None:
    """Set the markers of a loaded scene's events in a Blender scene. Markers of users stay."""
    key, wanted = _new_key(collection), _wanted(collection)
    present = set()
    for marker in list(scene.timeline_markers):
        owner, group = _owner(marker, key, wanted)
        if owner != key:
            continue
        place = (marker.name, marker.frame, group)
        if place in wanted and place not in present:
            present.add(place)
        else:
            scene.timeline_markers.remove(marker)
    for name, frame, group in sorted(wanted - present):
        marker = scene.timeline_markers.new(name, frame=frame)
        with contextlib.suppress(TypeError):  # see `_owner`
            marker[SCENE], marker[GROUP] = key, group


def shown(scene: bpy.types.Scene, collection: bpy.types.Collection) -> bool:
    """Return True if no marker is missing or outdated."""
    key, wanted = _key(collection), _wanted(collection)
    owners = [(marker, *_owner(marker, key, wanted)) for marker in scene.timeline_markers]
    own = [(marker.name, marker.frame, group) for marker, owner, group in owners if owner == key]
    return sorted(wanted) == sorted(own)


def _owner(
    marker: bpy.types.TimelineMarker, key: str, wanted: Collection[tuple[str, int, int]]
) -> tuple[str | None, int | None]:
    """Loaded scene and motion group of a marker, or None for both.

    Markers of Blender 5.0 cannot have custom properties. There, markers with a wanted name and frame belong to ``key``.
    """
    try:
        return marker.get(SCENE), marker.get(GROUP)
    except TypeError:
        groups = [group for name, frame, group in wanted if (name, frame) == (marker.name, marker.frame)]
        return (key, groups[0]) if groups else (None, None)


def _key(collection: bpy.types.Collection) -> str:
    """Id of a loaded scene; linked scenes without one are known by their name."""
    return collection.get(SCENE) or collection.name_full


def _new_key(collection: bpy.types.Collection) -> str:
    """Id of a loaded scene, created if it is missing or was copied."""
    same = [one for one in loaded_scenes.scene_collections() if one != collection and _key(one) == _key(collection)]
    if collection.library is None and (SCENE not in collection or same):
        collection[SCENE] = uuid.uuid4().hex
    return _key(collection)


def _wanted(collection: bpy.types.Collection) -> set[tuple[str, int, int]]:
    """Names, frames and motion groups of the markers. Shadows follow their casters, so they have none."""
    times, wanted = timeline.of_collection(collection), set()
    for anchor in loaded_scenes.members(collection, "ANCHOR"):
        if anchor.r5dgs_motion.learned_leader is None:
            for event in physics.history(anchor).events:
                frame = round(times.frame(event.time))
                wanted.add((f"{_label(anchor)}: {event.kind}", frame, anchor.r5dgs.motion_id))
    return wanted


def _label(anchor: bpy.types.Object) -> str:
    """Name of an anchor's object with Blender's number, which tells objects of several scenes apart."""
    return re.sub(r" anchor(?=(\.\d+)?$)", "", anchor.name)


@persistent
def _follow(scene, depsgraph=None):
    """Rename the markers of renamed objects, and remove those of scenes that are gone."""
    own = [marker for marker in scene.timeline_markers if _owner(marker, "", ())[0] is not None]
    if not own or threading.current_thread() is not threading.main_thread():
        return
    there = {_key(collection): collection for collection in loaded_scenes.shown(scene)}
    labels: dict[tuple[str, int], set[str]] = {}
    for key, collection in there.items():
        for anchor in loaded_scenes.members(collection, "ANCHOR"):
            labels.setdefault((key, anchor.r5dgs.motion_id), set()).add(_label(anchor))
    for marker in own:
        if marker[SCENE] not in there:
            scene.timeline_markers.remove(marker)
            continue
        label, colon, kind = marker.name.rpartition(": ")
        current = labels.get((marker[SCENE], marker.get(GROUP)), set())
        if colon and len(current) == 1 and label not in current:  # duplicates share a group
            marker.name = f"{next(iter(current))}: {kind}"


def register():
    """Register the handler."""
    bpy.app.handlers.depsgraph_update_post.append(_follow)


def unregister():
    """Undo `register`."""
    if _follow in bpy.app.handlers.depsgraph_update_post:
        bpy.app.handlers.depsgraph_update_post.remove(_follow)
