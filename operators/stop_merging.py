"""Stop Merging operator: undo Merge with Meshes."""

import bpy

from ..r5dgs_addon.engine import mesh_merge, mesh_shadows


class R5DGS_OT_stop_merging(bpy.types.Operator):
    """Remove the scene of the meshes and the compositor nodes that Merge with Meshes made"""

    bl_idname = "r5dgs.stop_merging"
    bl_label = "Stop Merging"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if mesh_merge.of(context.scene) is None:
            cls.poll_message_set("Nothing is merged with this scene")
            return False
        return True

    def execute(self, context):
        mesh_shadows.remove(context.scene)
        mesh_merge.remove(context.scene)
        return {"FINISHED"}


CLASSES = (R5DGS_OT_stop_merging,)
