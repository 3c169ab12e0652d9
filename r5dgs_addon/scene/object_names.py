"""Object table of a loaded scene: names of the objects and the data-blocks that belong to them.

Renaming an object in the Outliner renames it in the table. Loading stores the assigned name on the collection, anchor
and point cloud of each object. If a user renamed all data-blocks of one of these types, their new name is the object's.
No handler is needed, because `names` is evaluated whenever names are shown, searched or exported.
"""

import re

import bpy
from bpy.props import BoolProperty, IntProperty, PointerProperty, StringProperty

from ...r5dgs_core import errors
from ...r5dgs_core.search import object_search

NAME_BYTES = 63  # Blender's limit; cutting here keeps multi-byte characters whole
NOBODY = -2  # id of no object; -1 marks unassigned Gaussians
_NUMBER = re.compile(r"\.\d{3,}$")  # suffix that Blender adds to duplicate names
OTHERS_SUFFIX = " fringe"  # suffix of the collection of an object's other point clouds
_ANCHOR = " anchor"
KINDS = ("COLLECTION", "ANCHOR", "CLOUD")  # data-blocks named after an object, in order of precedence


class R5DGS_PG_named(bpy.types.PropertyGroup):
    """Object that a collection, anchor or point cloud is named after."""

    object_id: IntProperty(name="Object Id", description="Object that gave the name", default=NOBODY, options=set())
    given: StringProperty(name="Name Given", description="Name assigned by R5DGS", options=set())
    meanings: BoolProperty(name="Meanings", description="The scene file stores word embeddings", options=set())


def fit(name: str) -> str:
    """Truncate a name to Blender's maximum length."""
    return name.encode()[:NAME_BYTES].decode(errors="ignore")


def remember(collection: bpy.types.Collection, meanings: bool) -> None:
    """Mark the data-blocks that are named after objects in a newly built scene.

    Args:
        meanings: True if its file stores embeddings.
    """
    collection.r5dgs_named.meanings = meanings
    largest: dict[int, bpy.types.Object] = {}
    for obj in collection.all_objects:
        state = obj.r5dgs
        if state.role == "CLOUD":
            known = largest.get(state.object_id)
            if known is None or state.count > known.r5dgs.count:
                largest[state.object_id] = obj
    for object_id, cloud in largest.items():
        blocks = [cloud, *(home for home in cloud.users_collection if home.name in collection.children)]
        if cloud.parent is not None and cloud.parent.r5dgs.object_id == object_id:
            blocks.append(cloud.parent)
        for block in blocks:
            block.r5dgs_named.object_id, block.r5dgs_named.given = object_id, block.name


def names(collection: bpy.types.Collection) -> dict[int, str]:
    """Current unique name of each object of a loaded scene's table, in table order."""
    result = {entry.object_id: entry.name for entry in collection.r5dgs.table}
    renamed = {}
    for object_id, blocks in _named_blocks(collection).items():
        name = _new_name(blocks)
        if name and object_id in result:
            renamed[object_id] = name
    taken = {name for object_id, name in result.items() if object_id not in renamed}
    for object_id in [object_id for object_id in result if object_id in renamed]:
        result[object_id] = _unique(renamed[object_id], taken)
        taken.add(result[object_id])
    return result


def name_of(entry: bpy.types.PropertyGroup) -> str:
    """Current name of one object. Like `names`, but skips other objects if nothing of this one was renamed."""
    collection = entry.id_data
    home = collection.children.get(entry.name)
    cloud = home.objects.get(entry.name) if home is not None else None
    if cloud is not None:
        blocks = [home, cloud]
        if cloud.parent is not None and cloud.parent.r5dgs_named.object_id == entry.object_id:
            blocks.append(cloud.parent)
        marks = [(block.name, block.r5dgs_named) for block in blocks]
        if all(mark.object_id == entry.object_id and mark.given == name for name, mark in marks):
            return entry.name
    return names(collection).get(entry.object_id, entry.name)


def labels(collection: bpy.types.Collection) -> list[object_search.Label]:
    """Names and aliases by which objects of a loaded scene are found; excludes the unassigned Gaussians."""
    current = names(collection)
    return [
        object_search.Label(entry.object_id, current[entry.object_id], tuple(alias.name for alias in entry.aliases))
        for entry in collection.r5dgs.table
        if entry.object_id >= 0
    ]


def present(collection: bpy.types.Collection) -> set[int]:
    """Ids of the objects that have point clouds, that is, were not deleted."""
    return {obj.r5dgs.object_id for obj in collection.all_objects if obj.r5dgs.role == "CLOUD"}


def clouds(collection: bpy.types.Collection, object_id: int) -> list[bpy.types.Object]:
    """Point clouds of an object, including its duplicates."""
    return [o for o in collection.all_objects if o.r5dgs.role == "CLOUD" and o.r5dgs.object_id == object_id]


def entry_of(collection: bpy.types.Collection, object_id: int):
    """Table entry of an object, or None."""
    return next((entry for entry in collection.r5dgs.table if entry.object_id == object_id), None)


def rename(collection: bpy.types.Collection, object_id: int, wanted: str) -> str:
    """Rename an object in the table, with its collection, anchor, point clouds and shadow.

    Args:
        object_id: Object of its table.
        wanted: New name.

    Returns:
        The resulting name: ``wanted``, with a number if another object of the scene has that name.

    Raises:
        ConfigError: The name is empty, or the scene is linked from another file.
    """
    entry = entry_of(collection, object_id)
    if entry is None:
        raise ValueError(f"no object {object_id} in the table of {collection.name}")
    if collection.library is not None:
        raise errors.ConfigError(
            f"{collection.name}: linked from {collection.library.filepath}; rename its objects there"
        )
    if not wanted.strip():
        raise errors.ConfigError(f"{entry.name}: expected a name, found none")
    current = names(collection)
    old = current.pop(object_id)
    name = fit(_unique(wanted.strip(), set(current.values())))
    former = {old, entry.name}
    entry.name = name
    for kind, blocks in _named_blocks(collection).get(object_id, {}).items():
        for block in [b for b in blocks if _has_given_name(b)] or blocks[:1]:
            block.name = fit(name + _ANCHOR if kind == "ANCHOR" else name)
            block.r5dgs_named.given = block.name
            if kind == "CLOUD" and block.data.library is None:
                block.data.name = block.name
    for home in collection.children_recursive:
        if not home.r5dgs_named.given and home.name in {f"{word}{OTHERS_SUFFIX}" for word in former}:
            home.name = fit(name + OTHERS_SUFFIX)
    for obj in collection.all_objects:
        if not obj.r5dgs_named.given and obj.r5dgs.role in ("ANCHOR", "CLOUD"):
            changed = obj.name
            for word in former:
                changed = _rename_part(changed, word, name, obj.r5dgs.object_id == object_id, obj.r5dgs.object_id <= 0)
            if changed != obj.name:
                obj.name = fit(changed)
    return name


def _named_blocks(collection: bpy.types.Collection) -> dict[int, dict[str, list]]:
    """Data-blocks named after each object, by kind."""
    result: dict[int, dict[str, list]] = {}
    for block in (*collection.children_recursive, *collection.all_objects):
        named = block.r5dgs_named
        if named.given:
            kind = "COLLECTION" if isinstance(block, bpy.types.Collection) else block.r5dgs.role
            result.setdefault(named.object_id, {}).setdefault(kind, []).append(block)
    return result


def _has_given_name(block) -> bool:
    """True if a data-block still has the assigned name, ignoring Blender's number suffix."""
    name, given = block.name, block.r5dgs_named.given
    return name == given or _NUMBER.sub("", name) == _NUMBER.sub("", given)


def _new_name(blocks: dict[str, list]) -> str:
    """Name assigned by the user, from the first kind without any data-block of the former name; "" if none."""
    for kind in KINDS:
        named = blocks.get(kind, ())
        if not named or any(_has_given_name(block) for block in named):
            continue
        name = named[0].name
        plain = _NUMBER.sub("", name)
        siblings = bpy.data.collections if kind == "COLLECTION" else bpy.data.objects
        if siblings.get(plain) is not None:  # otherwise the user typed the number
            name = plain
        return name.removesuffix(_ANCHOR) if kind == "ANCHOR" else name
    return ""


def _unique(name: str, taken: set[str]) -> str:
    number, result = 1, name
    while result in taken:
        number += 1
        result = f"{name} {number}"
    return result


def _rename_part(text: str, old: str, new: str, own: bool, shadow: bool) -> str:
    """Rename a part such as 'mug still', 'mug shadow' or 'background with mug' after its object was renamed."""
    text = re.sub(rf"(?<= with ){re.escape(old)}(?=$|{_ANCHOR}| shadow|\.\d)", lambda _: new, text)
    parts = [part for part, belongs in ((" still", own), (" with ", own), (" shadow", shadow)) if belongs]
    return re.sub(rf"^{re.escape(old)}(?={'|'.join(parts)})", lambda _: new, text) if parts else text


def register():
    """Register the property group on objects and collections."""
    bpy.utils.register_class(R5DGS_PG_named)
    bpy.types.Object.r5dgs_named = PointerProperty(type=R5DGS_PG_named)
    bpy.types.Collection.r5dgs_named = PointerProperty(type=R5DGS_PG_named)


def unregister():
    """Undo `register`."""
    del bpy.types.Collection.r5dgs_named
    del bpy.types.Object.r5dgs_named
    bpy.utils.unregister_class(R5DGS_PG_named)
