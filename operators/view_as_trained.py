"""View as Trained operator: show the active scene as splats, from its best captured camera."""

import bpy

from ..r5dgs_addon.scene import first_view, loaded_scenes, polls, viewport_display


class R5DGS_OT_view_as_trained(polls.NeedsScene, bpy.types.Operator):
    """Show the scene as splats in all 3D views, from the captured camera that sees the objects best"""

    bl_idname = "r5dgs.view_as_trained"
    bl_label = "View as Trained"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        collection = loaded_scenes.active_collection(context)
        if loaded_scenes.is_own(collection) and collection.r5dgs.display != viewport_display.SPLATS:
            viewport_display.show(collection, viewport_display.SPLATS)
        if loaded_scenes.VIEW not in collection:
            self.report(
                {"WARNING"}, f"{collection.r5dgs.scene_name}: no captured camera is stored; load the file again"
            )
        elif not first_view.show(context, collection) and not bpy.app.background:
            self.report({"WARNING"}, "Every 3D view looks through a camera or is locked")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_view_as_trained,)
