"""Words to objects, from the table that the .blend file keeps: neither the scene file nor torch is needed."""

from dataclasses import dataclass

import bpy

from ..r5dgs_core.scene import lookup
from . import objects


@dataclass(frozen=True)
class Match:
    """One answer: an object, how well it matches (at most 1), and what matched."""

    object_id: int
    name: str
    score: float
    why: str


def search(collection: bpy.types.Collection, text: str) -> list[Match]:
    """Objects of a loaded scene that words name, best first; empty where nothing matches."""
    labels = remembered(collection)
    names = {label.object_id: label.name for label in labels}
    found = lookup.search_labels(labels, text)
    return [Match(match.object_id, names[match.object_id], match.score, match.why) for match in found]


def remembered(collection: bpy.types.Collection) -> list[lookup.Label]:
    """What the objects of a loaded scene answer to; the unassigned Gaussians answer to nothing."""
    return [
        lookup.Label(entry.object_id, entry.name, tuple(alias.name for alias in entry.aliases))
        for entry in collection.r5dgs.table
        if entry.object_id >= 0
    ]


def show(session: bpy.types.PropertyGroup, text: str, matches: list[Match]) -> None:
    """Put the answers where the sidebar shows them."""
    session.prompt, session.asked = text, text
    session.matches.clear()
    for match in matches:
        item = session.matches.add()
        item.name, item.object_id, item.score, item.why = match.name, match.object_id, match.score, match.why


def select(context: bpy.types.Context, collection: bpy.types.Collection, object_ids: list[int], mode: str) -> list[str]:
    """Change the selection by the clouds and anchors of some objects; the best one's anchor becomes active.

    Args:
        context: Its view layer's selection is changed.
        collection: A loaded scene.
        object_ids: Objects, best first.
        mode: "SET", "ADD" or "SUBTRACT".

    Returns:
        Names of what is hidden and therefore cannot be selected.
    """
    if mode == "SET":
        for selected in context.selected_objects:
            selected.select_set(False)
    missed, active = [], None
    for obj in objects.members(collection, "CLOUD", "ANCHOR"):
        if obj.r5dgs.object_id not in object_ids:
            continue
        if not obj.visible_get(view_layer=context.view_layer):
            missed.append(obj.name)
            continue
        obj.select_set(mode != "SUBTRACT")
        rank = (object_ids.index(obj.r5dgs.object_id), obj.r5dgs.role != "ANCHOR")
        if active is None or rank < active[0]:
            active = (rank, obj)
    if active is not None and mode != "SUBTRACT":
        context.view_layer.objects.active = active[1]
    return missed
