"""Assign Gaussians operator: give the selected Gaussians to an object."""

import bpy

from ..r5dgs_addon.clean_up import selected_points, split
from ..r5dgs_addon.scene import object_names, polls
from ..r5dgs_addon.ui import plural
from ..r5dgs_core import errors


class R5DGS_OT_assign_gaussians(polls.OfObject, selected_points.NeedsSelected, bpy.types.Operator):
    """Assign the selected Gaussians to the active object; they then move with it"""

    bl_idname = "r5dgs.assign_gaussians"
    bl_label = "Assign to Object"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        found = self.found(context)
        if found is None:
            self.report({"ERROR"}, "No object: make an object of the scene active first")
            return {"CANCELLED"}
        try:
            count = split.assign(context, *found)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        name = object_names.names(found[0])[found[1]]
        self.report({"INFO"}, f"{plural.of(count, 'Gaussian')} assigned to {name}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_assign_gaussians,)
