"""Delete Gaussians operator: delete the selected Gaussians."""

import bpy

from ..r5dgs_addon.clean_up import selected_points, split
from ..r5dgs_addon.scene import loaded_scenes
from ..r5dgs_addon.ui import plural
from ..r5dgs_core import errors


class R5DGS_OT_delete_gaussians(selected_points.NeedsSelected, bpy.types.Operator):
    """Delete the selected Gaussians; exported scenes omit them"""

    bl_idname = "r5dgs.delete_gaussians"
    bl_label = "Delete Gaussians"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        try:
            count = split.delete(context, loaded_scenes.active_collection(context))
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{plural.of(count, 'Gaussian')} deleted")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_delete_gaussians,)
