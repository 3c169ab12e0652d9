"""Isolation of objects of loaded scenes: all others are hidden, and later restored.

Objects are hidden in the view layer (point clouds and anchors) and in renders (point clouds). The changes are recorded
in the .blend, so that a saved file can be restored. Only objects of loaded scenes are changed.
"""

import bpy

from . import loaded_scenes, presence_keys, selection


def isolate(context: bpy.types.Context, wanted: list[selection.Wanted]) -> int:
    """Show the given objects and hide all others of the scenes loaded in the Blender scene.

    Args:
        context: Context whose scene and view layer change.
        wanted: Objects to show, even if hidden before.

    Returns:
        Number of objects that are hidden.
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
                hidden.add(item)  # otherwise instanced from a library, and cannot be hidden alone
            before = (obj.hide_get(view_layer=layer), presence_keys.is_hidden_in_renders(obj))
            after = (hide if obj in shown_here else before[0], _may_render(obj, hide))
            if before != after:
                record = state.hidden.add()
                record.obj, record.hide, record.hide_render = obj, *before
                _set(obj, layer, *after)
    return len(hidden)


def restore(scene: bpy.types.Scene) -> bool:
    """Restore the visibility before `isolate`. Returns True if objects were isolated."""
    state = scene.r5dgs_words
    layer = scene.view_layers.get(state.hidden_in)
    known = set(layer.objects) if layer is not None else set()
    for record in state.hidden:
        if record.obj is not None:  # else deleted in the meantime
            _set(record.obj, layer if record.obj in known else None, record.hide, record.hide_render)
    was = is_isolated(scene)
    state.hidden.clear()
    state.hidden_in = ""
    return was


def is_isolated(scene: bpy.types.Scene) -> bool:
    """True if objects are isolated."""
    return bool(scene.r5dgs_words.hidden_in)


def _may_render(obj: bpy.types.Object, hide: bool) -> bool:
    """New value of ``hide_render``, unchanged for anchors (never rendered) and linked objects (read-only)."""
    changes = obj.r5dgs.role == "CLOUD" and obj.library is None
    return hide if changes else presence_keys.is_hidden_in_renders(obj)


def _set(obj: bpy.types.Object, layer: bpy.types.ViewLayer | None, hide: bool, hide_render: bool) -> None:
    if layer is not None:
        obj.hide_set(hide, view_layer=layer)
    if presence_keys.is_hidden_in_renders(obj) != hide_render:
        presence_keys.hide_in_renders(obj, hide_render)
