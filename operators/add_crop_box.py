"""Add Crop Box operator: a box around the objects, for the panel Clean Up."""

import bpy

from ..r5dgs_addon.clean_up import criteria
from ..r5dgs_addon.scene import loaded_scenes, polls


class R5DGS_OT_add_crop_box(polls.NeedsScene, bpy.types.Operator):
    """Add a box around the objects. Move, rotate and scale it, then select the Gaussians outside it"""

    bl_idname = "r5dgs.add_crop_box"
    bl_label = "Add Crop Box"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if context.mode != "OBJECT":
            cls.poll_message_set("Switch to Object Mode first")
            return False
        return super().poll(context)

    def execute(self, context):
        collection = loaded_scenes.active_collection(context)
        if not loaded_scenes.is_own(collection):
            self.report({"ERROR"}, f"{collection.name}: comes from another .blend file; append it here")
            return {"CANCELLED"}
        box = criteria.add_box(context, collection)
        self.report({"INFO"}, f"{box.name} added")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_add_crop_box,)
