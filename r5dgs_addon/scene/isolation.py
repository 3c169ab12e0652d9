"""Isolating objects of loaded scenes: all others are hidden, and shown again as they were.

Hidden are the eye of the view layer (clouds and anchors) and renders (clouds). What that changed is kept in the .blend,
so that a saved file can still go back. Nothing but objects of loaded scenes is touched.
"""

import bpy

from . import loaded_scenes, selection


def isolate(context: bpy.types.Context, wanted: list[selection.Wanted]) -> int:
    """Show some objects and hide the others of all scenes loaded in the Blender scene.

    Args:
        context: Its scene and view layer are changed.
        wanted: What to show, though it was hidden.

    Returns:
        How many objects of the tables are hidden by that.
    """
    restore(context.scene)
    state, layer = context.scene.r5dgs_words, context.view_layer
    state.hidden_in = layer.name
    shown_here = set(layer.objects)
    hidden = set()
    for collection in selection.scenes(context):
        for obj in loaded_scenes.members(collection, "CLOUD", "ANCHOR"):
            item = (collection, obj.r5dgs.object_id)
            hide = item not in wanted
            if hide and obj.r5dgs.role == "CLOUD" and (obj in shown_here or obj.library is None):
                hidden.add(item)  # else it is instanced from a library, and cannot be hidden by itself
            before = (obj.hide_get(view_layer=layer), obj.hide_render)
            after = (hide if obj in shown_here else before[0], _may_render(obj, hide))
            if before != after:
                record = state.hidden.add()
                record.obj, record.hide, record.hide_render = obj, *before
                _set(obj, layer, *after)
    return len(hidden)


def restore(scene: bpy.types.Scene) -> bool:
    """Show everything as it was before `isolate`. Returns whether anything was isolated."""
    state = scene.r5dgs_words
    layer = scene.view_layers.get(state.hidden_in)
    known = set(layer.objects) if layer is not None else set()
    for record in state.hidden:
        if record.obj is not None:  # else deleted since
            _set(record.obj, layer if record.obj in known else None, record.hide, record.hide_render)
    was = is_isolated(scene)
    state.hidden.clear()
    state.hidden_in = ""
    return was


def is_isolated(scene: bpy.types.Scene) -> bool:
    """Whether objects are isolated."""
    return bool(scene.r5dgs_words.hidden_in)


def _may_render(obj: bpy.types.Object, hide: bool) -> bool:
    """What ``hide_render`` becomes: anchors are never rendered, linked data is not ours to change."""
    return hide if obj.r5dgs.role == "CLOUD" and obj.library is None else obj.hide_render


def _set(obj: bpy.types.Object, layer: bpy.types.ViewLayer | None, hide: bool, hide_render: bool) -> None:
    if layer is not None:
        obj.hide_set(hide, view_layer=layer)
    if obj.hide_render != hide_render:
        obj.hide_render = hide_render
