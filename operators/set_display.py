"""Set Display operator: show the Gaussians of a loaded scene as splats, points or ellipsoids."""

import bpy
from bpy.props import EnumProperty

from ..r5dgs_addon.scene import loaded_scenes, polls, viewport_display


class R5DGS_OT_set_display(polls.NeedsScene, bpy.types.Operator):
    """Choose the representation of this scene's Gaussians in viewports"""

    bl_idname = "r5dgs.set_display"
    bl_label = "Set Display"
    bl_options = {"REGISTER", "UNDO"}

    display: EnumProperty(name="Display", description="Representation of Gaussians", items=viewport_display.ITEMS)

    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        if not loaded_scenes.is_own(loaded_scenes.active_collection(context)):
            cls.poll_message_set("This R5DGS scene is linked from another file: set its display there")
            return False
        return True

    def execute(self, context):
        viewport_display.show(loaded_scenes.active_collection(context), self.display)
        return {"FINISHED"}


CLASSES = (R5DGS_OT_set_display,)
