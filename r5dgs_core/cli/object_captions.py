"""Names, aliases and captions that a user gives to the objects of a scene."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from .. import errors

if TYPE_CHECKING:
    from ..scene.scene import Scene, SceneObject


def apply(scene: Scene, captions: dict[str, Any], place: str) -> Scene:
    """Return the scene with changed names, aliases and captions.

    Args:
        scene: The scene.
        captions: Maps the id or name of an object to a caption, or to a dict with ``name aliases caption``.
        place: Origin of ``captions``, for messages.

    Raises:
        ConfigError: An object is missing, a name is taken or empty, or a value has the wrong type.
    """
    changed = {item.id: item for item in scene.objects}
    for which, value in captions.items():
        item = changed[find(scene, which, place).id]
        entry = {"caption": value} if isinstance(value, str) else value
        if not isinstance(entry, dict) or set(entry) - {"name", "aliases", "caption"}:
            raise errors.ConfigError(f"{place}: {which}: expected a caption, or name, aliases and caption")
        changed[item.id] = replace(
            item,
            name=_text(entry, "name", item.name, place, which),
            caption=_text(entry, "caption", item.caption, place, which),
            aliases=_aliases(entry, item, place, which),
        )
    owners: dict[str, int] = {}
    for item in changed.values():
        if not item.name:
            raise errors.ConfigError(f"{place}: object {item.id}: expected a name, found an empty one")
        if item.name in owners:
            raise errors.ConfigError(
                f"{place}: the name {item.name!r} is taken by object {owners[item.name]}; choose another, or add an "
                "alias, which several objects may share"
            )
        owners[item.name] = item.id
    return replace(scene, objects=tuple(changed[item.id] for item in scene.objects))


def find(scene: Scene, which: str, place: str) -> SceneObject:
    """Return the object with this id or name. Ids are tried first, because a name may equal another object's id."""
    for known in ({str(item.id): item for item in scene.objects}, {item.name: item for item in scene.objects}):
        if which in known:
            return known[which]
    there = ", ".join(f"{item.id} {item.name!r}" for item in scene.objects)
    raise errors.ConfigError(f"{place}: expected an object of the scene, found {which!r}; there are {there}")


def _text(entry: dict[str, Any], key: str, before: str, place: str, which: str) -> str:
    value = entry.get(key, before)
    if not isinstance(value, str):
        raise errors.ConfigError(f"{place}: {which}: {key}: expected text, found {value!r}")
    return value.strip()


def _aliases(entry: dict[str, Any], item: SceneObject, place: str, which: str) -> tuple[str, ...]:
    aliases = entry.get("aliases", item.aliases)
    if not isinstance(aliases, list | tuple) or not all(isinstance(alias, str) for alias in aliases):
        raise errors.ConfigError(f"{place}: {which}: aliases: expected a list of words, found {aliases!r}")
    return tuple(dict.fromkeys(alias.strip() for alias in aliases if alias.strip()))
