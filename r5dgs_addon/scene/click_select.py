"""Selection of anchors by clicking Gaussians in a 3D view. The Outliner still selects point clouds.

Blender notifies the extension when the active object changes. If the last operator was a click in a 3D view and the new
active object is a point cloud, its anchor is selected instead.
"""

import bpy
from bpy.app.handlers import persistent

CLICK = "VIEW3D_OT_select"
_listener = object()  # owner of the message bus subscription
_active = [0]  # `session_uid` of the active object after the last notification


def follow(context: bpy.types.Context, extend: bool, before: int = 0) -> bpy.types.Object | None:
    """Replace the active point cloud in the selection by its anchor.

    Args:
        context: Context whose view layer's selection changes.
        extend: True to keep other objects selected. An anchor that was already active is deselected, as in Blender.
        before: ``session_uid`` of the active object before the click; 0 if unknown.

    Returns:
        The anchor, or None if the active object is no point cloud with a selectable anchor.
    """
    layer = context.view_layer
    cloud = layer.objects.active
    if cloud is None or cloud.r5dgs.role != "CLOUD":
        return None
    anchor = cloud.parent
    if anchor is None or anchor.r5dgs.role != "ANCHOR" or anchor.hide_select:
        return None
    if not anchor.visible_get(view_layer=layer):
        return None
    taken_out = extend and anchor.session_uid == before and anchor.select_get(view_layer=layer)
    if not extend:
        for chosen in context.selected_objects:
            chosen.select_set(False)
    cloud.select_set(False)
    anchor.select_set(not taken_out)
    layer.objects.active = anchor
    return anchor


def listen() -> None:
    """Subscribe to changes of the active object. Blender drops subscriptions when it opens a file."""
    bpy.msgbus.clear_by_owner(_listener)
    bpy.msgbus.subscribe_rna(
        key=(bpy.types.LayerObjects, "active"), owner=_listener, args=(), notify=_when_active_changes
    )


def _when_active_changes() -> None:
    context = bpy.context
    if context.scene is None or context.mode != "OBJECT":
        return
    before = _active[0]
    done = context.window_manager.operators
    if context.scene.r5dgs_words.click_selects_anchor and done and done[-1].bl_idname == CLICK:
        click = done[-1].properties
        if follow(context, click.extend or click.toggle, before) is not None:
            bpy.ops.ed.undo_push(message="Select Anchor")
    active = context.view_layer.objects.active
    _active[0] = 0 if active is None else active.session_uid


@persistent
def _after_load(*_) -> None:
    listen()


def register():
    """Subscribe now and after each file is opened."""
    bpy.app.handlers.load_post.append(_after_load)
    listen()


def unregister():
    """Undo `register`."""
    bpy.msgbus.clear_by_owner(_listener)
    if _after_load in bpy.app.handlers.load_post:
        bpy.app.handlers.load_post.remove(_after_load)
