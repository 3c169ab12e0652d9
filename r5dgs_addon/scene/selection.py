"""Selection of objects of loaded scenes, and lookup of the object that a selected Blender object belongs to."""

import bpy

from . import loaded_scenes, object_names

Wanted = tuple[bpy.types.Collection, int]  # loaded scene, and id of one of its objects
NO_SCENE = "Load an R5DGS scene first"


def why_unavailable(context: bpy.types.Context) -> str:
    """Reason why objects of scenes cannot be selected now, as a message for the user, or ""."""
    if context.mode != "OBJECT":
        return "Switch to Object Mode first"
    return "" if scenes(context) else NO_SCENE


def scenes(context: bpy.types.Context) -> list[bpy.types.Collection]:
    """Loaded scenes in the active Blender scene, including instanced ones; the active one first."""
    active = loaded_scenes.active_collection(context)
    if active is None:
        return []
    return [active] + [found for found in loaded_scenes.shown(context.scene) if found != active]


def find(context: bpy.types.Context, scene: str, object_id: int) -> Wanted | None:
    """Find the object that an operator's properties name.

    Args:
        context: Context with the active object and scene.
        scene: Name of a loaded scene's collection, or "" for any.
        object_id: Id in its table, or `object_names.NOBODY` for the active object's.

    Returns:
        Scene and object id, or None if not found.
    """
    loaded = scenes(context)
    if scene:
        loaded = [collection for collection in loaded if collection.name == scene]
    if object_id == object_names.NOBODY:
        active = context.view_layer.objects.active
        return owner(loaded, active) if active is not None else None
    for collection in loaded:
        if object_names.entry_of(collection, object_id) is not None:
            return collection, object_id
    return None


def owner(loaded: list[bpy.types.Collection], obj: bpy.types.Object) -> Wanted | None:
    """Scene and object id that an anchor or point cloud belongs to; None for other objects."""
    if obj.r5dgs.role not in ("ANCHOR", "CLOUD"):
        return None
    for collection in loaded:
        if collection.all_objects.get(obj.name) == obj:
            return collection, obj.r5dgs.object_id
    return None


def selected(context: bpy.types.Context) -> list[Wanted]:
    """Objects with a selected anchor or point cloud, the active one first."""
    loaded, active = scenes(context), context.view_layer.objects.active
    chosen = sorted(context.selected_objects, key=lambda obj: obj != active)
    return list(dict.fromkeys(found for obj in chosen if (found := owner(loaded, obj)) is not None))


def select(context: bpy.types.Context, wanted: list[Wanted], mode: str) -> list[str]:
    """Select or deselect the point clouds and anchors of objects. The first object's anchor becomes active.

    For an instanced scene, its instancers are selected instead.

    Args:
        context: Context whose view layer's selection changes.
        wanted: Objects, best first.
        mode: "SET", "ADD" or "SUBTRACT".

    Returns:
        Names of hidden objects, which cannot be selected.
    """
    if mode == "SET":
        for chosen in context.selected_objects:
            chosen.select_set(False)
    missed, best, instanced = [], None, loaded_scenes.shown(context.scene)
    for collection in dict.fromkeys(collection for collection, _ in wanted):
        instancers = instanced.get(collection)
        for obj in instancers or loaded_scenes.members(collection, "CLOUD", "ANCHOR"):
            first = next(one for one in wanted if one[0] == collection)
            item = first if instancers else (collection, obj.r5dgs.object_id)
            if item not in wanted:
                continue
            if not obj.visible_get(view_layer=context.view_layer):
                missed.append(obj.name)
                continue
            obj.select_set(mode != "SUBTRACT")
            rank = (wanted.index(item), obj.r5dgs.role != "ANCHOR")
            if best is None or rank < best[0]:
                best = (rank, obj)
    if best is not None and mode != "SUBTRACT":
        context.view_layer.objects.active = best[1]
    return missed
