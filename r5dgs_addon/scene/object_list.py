"""Getters and setters of the properties shown in a row of the objects list.

A row is an entry of the table. An object may have several point clouds, which are changed together.
"""

import bpy
import numpy as np

from ...r5dgs_core.color import srgb
from . import object_names, object_tint, presence_keys, selection

GREY = (0.5, 0.5, 0.5)


def label(entry: bpy.types.PropertyGroup) -> str:
    """Name of the object."""
    return object_names.name_of(entry)


def set_label(entry: bpy.types.PropertyGroup, name: str) -> None:
    """Rename the object. Does nothing if the name is empty or the scene is linked."""
    if name.strip() and entry.id_data.library is None:
        object_names.rename(entry.id_data, entry.object_id, name)


def color(entry: bpy.types.PropertyGroup) -> tuple[float, float, float]:
    """Display-referred mean color of the object, times its tint."""
    own = object_names.clouds(entry.id_data, entry.object_id)
    if not own:
        return GREY
    plain = own[0].r5dgs_look.plain if own[0].r5dgs_look.shown else own[0].color
    return tuple(np.minimum(srgb.from_linear(np.minimum(plain[:3], 1)) * object_tint.tint(own[0]), 1).tolist())


def set_tint(entry: bpy.types.PropertyGroup, value) -> None:
    """Tint the object."""
    object_tint.recolor(object_names.clouds(entry.id_data, entry.object_id), value)


def tint(entry: bpy.types.PropertyGroup) -> tuple[float, float, float]:
    """Tint of the object."""
    own = object_names.clouds(entry.id_data, entry.object_id)
    return tuple(own[0].r5dgs_look.tint) if own else object_tint.NONE


def is_hidden(entry: bpy.types.PropertyGroup) -> bool:
    """True if all point clouds of the object are hidden in the view layer."""
    layer = bpy.context.view_layer
    return all(cloud.hide_get(view_layer=layer) for cloud in object_names.clouds(entry.id_data, entry.object_id))


def set_hidden(entry: bpy.types.PropertyGroup, hide: bool) -> None:
    """Hide or show the object in the view layer."""
    layer = bpy.context.view_layer
    for cloud in object_names.clouds(entry.id_data, entry.object_id):
        if cloud in layer.objects.values():
            cloud.hide_set(hide, view_layer=layer)


def is_hidden_in_renders(entry: bpy.types.PropertyGroup) -> bool:
    """True if all point clouds of the object are disabled in renders."""
    return all(
        presence_keys.is_hidden_in_renders(cloud) for cloud in object_names.clouds(entry.id_data, entry.object_id)
    )


def set_hidden_in_renders(entry: bpy.types.PropertyGroup, hide: bool) -> None:
    """Disable or enable the object in renders."""
    for cloud in object_names.clouds(entry.id_data, entry.object_id):
        if cloud.library is None:
            presence_keys.hide_in_renders(cloud, hide)


def active_row(state: bpy.types.PropertyGroup) -> int:
    """Row of the active object in its scene's list, or -1."""
    active = bpy.context.view_layer.objects.active
    found = selection.owner([state.id_data], active) if active is not None else None
    ids = [entry.object_id for entry in state.table]
    return ids.index(found[1]) if found is not None and found[1] in ids else -1


def set_active_row(state: bpy.types.PropertyGroup, row: int) -> None:
    """Select only the object of a row."""
    context = bpy.context
    if 0 <= row < len(state.table) and not selection.why_unavailable(context):
        selection.select(context, [(state.id_data, state.table[row].object_id)], "SET")
