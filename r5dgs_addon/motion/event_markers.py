"""Timeline markers of observed events, such as "ball: impact"."""

from collections.abc import Iterator

import bpy

from ..scene import loaded_scenes, timeline
from . import physics


def show(scene: bpy.types.Scene, collection: bpy.types.Collection) -> None:
    """Add the markers of a loaded scene's events that a Blender scene lacks."""
    present = {(marker.name, marker.frame) for marker in scene.timeline_markers}
    for name, frame in _wanted(collection):
        if (name, frame) not in present:
            scene.timeline_markers.new(name, frame=frame)


def shown(scene: bpy.types.Scene, collection: bpy.types.Collection) -> bool:
    """Return True if no marker is missing."""
    return set(_wanted(collection)) <= {(marker.name, marker.frame) for marker in scene.timeline_markers}


def _wanted(collection: bpy.types.Collection) -> Iterator[tuple[str, int]]:
    """Names and frames of the markers. Shadows follow their casters, so they have none."""
    times = timeline.of_collection(collection)
    for anchor in loaded_scenes.members(collection, "ANCHOR"):
        if anchor.r5dgs_motion.learned_leader is not None:
            continue
        for event in physics.history(anchor).events:
            yield f"{anchor.name.removesuffix(' anchor')}: {event.kind}", round(times.frame(event.time))
