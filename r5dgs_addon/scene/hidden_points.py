"""Visibility of the points of scenes shown as splats: they are hidden only while the extension runs.

The modifier *R5DGS Splats* hides the points in viewports. It is switched off when the extension is disabled and while a
.blend file is saved, so that the points are visible without the extension, and on again after saving and opening.
"""

import bpy
from bpy.app.handlers import persistent

from . import loaded_scenes, viewport_display

_collections = [0]  # number of collections at the last update


@persistent
def hide(*_) -> None:
    """Hide the points of all loaded scenes shown as splats."""
    _collections[0] = len(bpy.data.collections)
    for collection in loaded_scenes.scene_collections():
        root = collection.r5dgs.root
        for obj in {*collection.all_objects, *(root.children_recursive if root is not None else ())}:
            _switch(obj, True)


@persistent
def show(*_) -> None:
    """Show the points of all clouds, also of those that are not in a loaded scene any more."""
    for obj in bpy.data.objects:
        _switch(obj, False)


def _switch(obj: bpy.types.Object, on: bool) -> None:
    modifier = obj.modifiers.get(viewport_display.SPLATS_MODIFIER)
    if modifier is not None and modifier.show_viewport != on:
        modifier.show_viewport = obj.show_in_front = on


@persistent
def _notice_import(*_):
    """Hide the points of scenes that were appended or linked. Blender has no event for this before 4.3."""
    if len(bpy.data.collections) != _collections[0]:
        hide()


def _hooks():
    handlers = bpy.app.handlers
    after = ("load_post", "undo_post", "redo_post", "save_post", "save_post_fail")
    return (
        *((getattr(handlers, name), hide) for name in after),
        (handlers.save_pre, show),
        (handlers.depsgraph_update_post, _notice_import),
    )


def register():
    """Register the handlers, and hide the points once Blender allows changes; enabling an extension does not."""
    for events, handler in _hooks():
        events.append(handler)
    if hasattr(bpy.data, "collections"):
        hide()
    else:
        bpy.app.timers.register(hide, first_interval=0.0)


def unregister():
    """Undo `register` and show the points."""
    for events, handler in _hooks():
        if handler in events:
            events.remove(handler)
    if bpy.app.timers.is_registered(hide):
        bpy.app.timers.unregister(hide)
    show()
