"""Timeline markers of observed events, such as "ball: impact".

A register in the Blender scene records the loaded scene and the motion group of each marker. Markers are therefore
renamed with their objects and removed with their loaded scene, while markers of users stay. A marker that a user
renames or moves counts as the user's. The register is a property of the scene because Blender 5.0 removed custom
properties of markers.
"""

import json
import re
import threading
import uuid
from typing import NamedTuple

import bpy
from bpy.app.handlers import persistent

from ..scene import loaded_scenes, timeline
from . import physics

SCENE = "r5dgs_scene"  # custom property of loaded scenes: their id
MARKERS = "r5dgs_markers"  # custom property of Blender scenes: JSON of the registered markers


class Entry(NamedTuple):
    """A registered marker: its name and frame, the id of the loaded scene, and the motion group."""

    name: str
    frame: int
    owner: str
    group: int


def show(scene: bpy.types.Scene, collection: bpy.types.Collection) -> None:
    """Set the markers of a loaded scene's events in a Blender scene. Markers of users stay."""
    wanted = _wanted(collection, _new_key(collection))
    registered = _registered(scene)
    others = [entry for entry in registered if entry.owner != _key(collection)]
    for entry in set(registered) - set(others) - wanted:
        _remove(scene, entry)
    for entry in sorted(wanted):
        if _marker(scene, entry) is None:
            scene.timeline_markers.new(entry.name, frame=entry.frame)
    _register(scene, [*others, *sorted(wanted)])


def shown(scene: bpy.types.Scene, collection: bpy.types.Collection) -> bool:
    """Return True if no marker is missing or outdated."""
    key = _key(collection)
    return _wanted(collection, key) == {entry for entry in _registered(scene) if entry.owner == key}


def _registered(scene: bpy.types.Scene) -> list[Entry]:
    """Registered markers that still exist."""
    entries = [Entry(*row) for row in json.loads(scene.get(MARKERS, "[]"))]
    return [entry for entry in entries if _marker(scene, entry) is not None]


def _register(scene: bpy.types.Scene, entries: list[Entry]) -> None:
    """Replace the registered markers."""
    if entries:
        scene[MARKERS] = json.dumps(entries)
    elif MARKERS in scene:
        del scene[MARKERS]


def _marker(scene: bpy.types.Scene, entry: Entry) -> bpy.types.TimelineMarker | None:
    """Return the marker of an entry, or None if it was removed, renamed or moved."""
    same = (marker for marker in scene.timeline_markers if (marker.name, marker.frame) == (entry.name, entry.frame))
    return next(same, None)


def _remove(scene: bpy.types.Scene, entry: Entry) -> None:
    """Remove the marker of an entry, unless a linked scene with equal names has removed it before."""
    if (marker := _marker(scene, entry)) is not None:
        scene.timeline_markers.remove(marker)


def _key(collection: bpy.types.Collection) -> str:
    """Id of a loaded scene; linked scenes without one are known by their name."""
    return collection.get(SCENE) or collection.name_full


def _new_key(collection: bpy.types.Collection) -> str:
    """Id of a loaded scene, created if it is missing or was copied."""
    same = [one for one in loaded_scenes.scene_collections() if one != collection and _key(one) == _key(collection)]
    if collection.library is None and (SCENE not in collection or same):
        collection[SCENE] = uuid.uuid4().hex
    return _key(collection)


def _wanted(collection: bpy.types.Collection, key: str) -> set[Entry]:
    """Markers of a loaded scene with id ``key``. Shadows follow their casters, so they have none."""
    times, wanted = timeline.of_collection(collection), set()
    for anchor in loaded_scenes.members(collection, "ANCHOR"):
        if anchor.r5dgs_motion.learned_leader is None:
            for event in physics.history(anchor).events:
                frame = round(times.frame(event.time))
                wanted.add(Entry(f"{_label(anchor)}: {event.kind}", frame, key, anchor.r5dgs.motion_id))
    return wanted


def _label(anchor: bpy.types.Object) -> str:
    """Name of an anchor's object with Blender's number, which distinguishes objects of several scenes."""
    return re.sub(r" anchor(?=(\.\d+)?$)", "", anchor.name)


@persistent
def _follow(scene, depsgraph=None):
    """Rename the markers of renamed objects, and remove those of scenes that are gone."""
    if MARKERS not in scene or threading.current_thread() is not threading.main_thread():
        return
    there = {_key(collection): collection for collection in loaded_scenes.shown(scene)}
    labels: dict[tuple[str, int], set[str]] = {}
    for key, collection in there.items():
        for anchor in loaded_scenes.members(collection, "ANCHOR"):
            labels.setdefault((key, anchor.r5dgs.motion_id), set()).add(_label(anchor))
    before, after = _registered(scene), []
    for entry in before:
        if entry.owner not in there:
            _remove(scene, entry)
            continue
        label, _, kind = entry.name.rpartition(": ")
        current = labels.get((entry.owner, entry.group), set())
        if len(current) == 1 and label not in current:  # duplicates share a group
            marker, entry = _marker(scene, entry), entry._replace(name=f"{next(iter(current))}: {kind}")
            marker.name = entry.name
        after.append(entry)
    if after != before:
        _register(scene, after)


def register():
    """Register the handler."""
    bpy.app.handlers.depsgraph_update_post.append(_follow)


def unregister():
    """Undo `register`."""
    if _follow in bpy.app.handlers.depsgraph_update_post:
        bpy.app.handlers.depsgraph_update_post.remove(_follow)
