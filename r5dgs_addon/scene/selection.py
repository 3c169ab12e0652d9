"""Objects of loaded scenes and Blender's selection: who is selected, selecting others, hiding all but some."""

import bpy

from . import loaded_scenes, object_names

Wanted = tuple[bpy.types.Collection, int]  # a loaded scene and the id of one of its objects
NO_SCENE = "Load an R5DGS scene first"


def obstacle(context: bpy.types.Context) -> str:
    """Why objects of scenes cannot be selected now, in words for the user; "" where they can."""
    if context.mode != "OBJECT":
        return "Switch to Object Mode first"
    return "" if scenes(context) else NO_SCENE


def scenes(context: bpy.types.Context) -> list[bpy.types.Collection]:
    """The loaded scenes in the active Blender scene, the active one first, instanced ones among them."""
    active = loaded_scenes.active_collection(context)
    if active is None:
        return []
    return [active] + [found for found in loaded_scenes.shown(context.scene) if found != active]


def find(context: bpy.types.Context, scene: str, object_id: int) -> Wanted | None:
    """The object that an operator's properties name: where they name no scene, the active object's.

    Args:
        context: Its active object and scene are asked.
        scene: Name of a loaded scene's collection, or "".
        object_id: Id in its table; `object_names.NOBODY` for the active object's.

    Returns:
        The scene and the id, or None where there is no such thing.
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
    """Which scene's object an anchor or a cloud belongs to; None for everything else."""
    if obj.r5dgs.role not in ("ANCHOR", "CLOUD"):
        return None
    for collection in loaded:
        if collection.all_objects.get(obj.name) == obj:
            return collection, obj.r5dgs.object_id
    return None


def selected(context: bpy.types.Context) -> list[Wanted]:
    """The objects of which an anchor or a cloud is selected, the active one first."""
    loaded, active = scenes(context), context.view_layer.objects.active
    chosen = sorted(context.selected_objects, key=lambda obj: obj != active)
    return list(dict.fromkeys(found for obj in chosen if (found := owner(loaded, obj)) is not None))


def select(context: bpy.types.Context, wanted: list[Wanted], mode: str) -> list[str]:
    """Change the selection by the clouds and anchors of some objects; the first one's anchor becomes active.

    Objects of an instanced scene cannot be selected: what instances it is instead.

    Args:
        context: Its view layer's selection is changed.
        wanted: Objects, best first.
        mode: "SET", "ADD" or "SUBTRACT".

    Returns:
        Names of what is hidden and therefore cannot be selected.
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
