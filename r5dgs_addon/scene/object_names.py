"""The table of a loaded scene: what its objects are called and which of Blender's data are theirs.

Whoever renames an object in the Outliner renames it in the table: loading marks the collection, the anchor and the
cloud that bear an object's name with the name given, and where none of one kind bears that any more, the new name
counts. No handler is needed for that; `names` is asked whenever names are shown, searched or exported.
"""

import re

import bpy
from bpy.props import BoolProperty, IntProperty, PointerProperty, StringProperty

from ...r5dgs_core import errors
from ...r5dgs_core.search import object_search

NAME_BYTES = 63  # Blender cuts longer names; cutting them here keeps whole characters
NOBODY = -2  # no object of any table; -1 are the unassigned Gaussians
_NUMBER = re.compile(r"\.\d{3,}$")  # what Blender adds to a name that is taken
_ANCHOR = " anchor"
KINDS = ("COLLECTION", "ANCHOR", "CLOUD")  # what bears an object's name, the most telling first


class R5DGS_PG_named(bpy.types.PropertyGroup):
    """Which object of the table a collection, an anchor or a cloud was named after."""

    object_id: IntProperty(name="Object Id", description="Object that it is named after", default=NOBODY, options=set())
    given: StringProperty(name="Name Given", description="Its name when R5DGS named it", options=set())
    meanings: BoolProperty(name="Meanings", description="Whether the scene file knows words by meaning", options=set())


def fit(name: str) -> str:
    """A name as long as Blender allows."""
    return name.encode()[:NAME_BYTES].decode(errors="ignore")


def remember(collection: bpy.types.Collection, meanings: bool) -> None:
    """Mark what bears the objects' names in a scene that was just built.

    Args:
        collection: The loaded scene.
        meanings: Whether its file stores embeddings.
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
        bearers = [cloud, *(home for home in cloud.users_collection if home.name in collection.children)]
        if cloud.parent is not None and cloud.parent.r5dgs.object_id == object_id:
            bearers.append(cloud.parent)
        for bearer in bearers:
            bearer.r5dgs_named.object_id, bearer.r5dgs_named.given = object_id, bearer.name


def names(collection: bpy.types.Collection) -> dict[int, str]:
    """What each object of a loaded scene's table is called now, unique, in the order of the table."""
    result = {entry.object_id: entry.name for entry in collection.r5dgs.table}
    renamed = {}
    for object_id, bearers in _bearers(collection).items():
        name = _new_name(bearers)
        if name and object_id in result:
            renamed[object_id] = name
    taken = {name for object_id, name in result.items() if object_id not in renamed}
    for object_id in [object_id for object_id in result if object_id in renamed]:
        result[object_id] = _unique(renamed[object_id], taken)
        taken.add(result[object_id])
    return result


def name_of(entry: bpy.types.PropertyGroup) -> str:
    """What one object is called now: as `names`, without looking at all others where nothing of it was renamed."""
    collection = entry.id_data
    home = collection.children.get(entry.name)
    cloud = home.objects.get(entry.name) if home is not None else None
    if cloud is not None:
        bearers = [home, cloud]
        if cloud.parent is not None and cloud.parent.r5dgs_named.object_id == entry.object_id:
            bearers.append(cloud.parent)
        marks = [(bearer.name, bearer.r5dgs_named) for bearer in bearers]
        if all(mark.object_id == entry.object_id and mark.given == name for name, mark in marks):
            return entry.name
    return names(collection).get(entry.object_id, entry.name)


def labels(collection: bpy.types.Collection) -> list[object_search.Label]:
    """What the objects of a loaded scene answer to; the unassigned Gaussians answer to nothing."""
    current = names(collection)
    return [
        object_search.Label(entry.object_id, current[entry.object_id], tuple(alias.name for alias in entry.aliases))
        for entry in collection.r5dgs.table
        if entry.object_id >= 0
    ]


def present(collection: bpy.types.Collection) -> set[int]:
    """Ids of the objects that have clouds; the others were deleted."""
    return {obj.r5dgs.object_id for obj in collection.all_objects if obj.r5dgs.role == "CLOUD"}


def clouds(collection: bpy.types.Collection, object_id: int) -> list[bpy.types.Object]:
    """The clouds of one object, its duplicates' among them."""
    return [o for o in collection.all_objects if o.r5dgs.role == "CLOUD" and o.r5dgs.object_id == object_id]


def entry_of(collection: bpy.types.Collection, object_id: int):
    """The table's entry of an object, or None."""
    return next((entry for entry in collection.r5dgs.table if entry.object_id == object_id), None)


def rename(collection: bpy.types.Collection, object_id: int, wanted: str) -> str:
    """Rename an object: in the table, and its collection, anchor, clouds and shadow with it.

    Args:
        collection: A loaded scene.
        object_id: Object of its table.
        wanted: The new name.

    Returns:
        The name that it has now: the one wanted, with a number where another object of the scene is called so.

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
    for kind, bearers in _bearers(collection).get(object_id, {}).items():
        for bearer in [b for b in bearers if _bears_given(b)] or bearers[:1]:
            bearer.name = fit(name + _ANCHOR if kind == "ANCHOR" else name)
            bearer.r5dgs_named.given = bearer.name
            if kind == "CLOUD" and bearer.data.library is None:
                bearer.data.name = bearer.name
    for obj in collection.all_objects:
        if not obj.r5dgs_named.given and obj.r5dgs.role in ("ANCHOR", "CLOUD"):
            changed = obj.name
            for word in former:
                changed = _rename_part(changed, word, name, obj.r5dgs.object_id == object_id, obj.r5dgs.object_id <= 0)
            if changed != obj.name:
                obj.name = fit(changed)
    return name


def _bearers(collection: bpy.types.Collection) -> dict[int, dict[str, list]]:
    """What was named after each object: its collections, anchors and clouds."""
    result: dict[int, dict[str, list]] = {}
    for bearer in (*collection.children_recursive, *collection.all_objects):
        named = bearer.r5dgs_named
        if named.given:
            kind = "COLLECTION" if isinstance(bearer, bpy.types.Collection) else bearer.r5dgs.role
            result.setdefault(named.object_id, {}).setdefault(kind, []).append(bearer)
    return result


def _bears_given(bearer) -> bool:
    """Whether it has the name that it was given; copies of it that Blender numbered have it too."""
    name, given = bearer.name, bearer.r5dgs_named.given
    return name == given or _NUMBER.sub("", name) == _NUMBER.sub("", given)


def _new_name(bearers: dict[str, list]) -> str:
    """The name that the user gave: of the first kind of which none bears the one given before; "" without any."""
    for kind in KINDS:
        named = bearers.get(kind, ())
        if not named or any(_bears_given(bearer) for bearer in named):
            continue
        name = named[0].name
        plain = _NUMBER.sub("", name)
        siblings = bpy.data.collections if kind == "COLLECTION" else bpy.data.objects
        if siblings.get(plain) is not None:  # then the number is Blender's doing
            name = plain
        return name.removesuffix(_ANCHOR) if kind == "ANCHOR" else name
    return ""


def _unique(name: str, taken: set[str]) -> str:
    number, result = 1, name
    while result in taken:
        number += 1
        result = f"{name} {number}"
    return result


def _rename_part(text: str, old: str, new: str, own: bool, nobodys: bool) -> str:
    """Name of a part, such as 'mug still', 'mug shadow' or 'background with mug', after its object was renamed."""
    text = re.sub(rf"(?<= with ){re.escape(old)}(?=$|{_ANCHOR}| shadow|\.\d)", lambda _: new, text)
    parts = [part for part, belongs in ((" still", own), (" with ", own), (" shadow", nobodys)) if belongs]
    return re.sub(rf"^{re.escape(old)}(?={'|'.join(parts)})", lambda _: new, text) if parts else text


def register():
    """Register the group and hang it on objects and collections."""
    bpy.utils.register_class(R5DGS_PG_named)
    bpy.types.Object.r5dgs_named = PointerProperty(type=R5DGS_PG_named)
    bpy.types.Collection.r5dgs_named = PointerProperty(type=R5DGS_PG_named)


def unregister():
    """Undo `register`."""
    del bpy.types.Collection.r5dgs_named
    del bpy.types.Object.r5dgs_named
    bpy.utils.unregister_class(R5DGS_PG_named)
