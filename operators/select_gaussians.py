"""Select Gaussians operator: all, none, or the inverse."""

import bpy
import numpy as np
from bpy.props import EnumProperty

from ..r5dgs_addon.clean_up import selected_points
from ..r5dgs_addon.scene import loaded_scenes, polls
from ..r5dgs_addon.ui import plural
from ..r5dgs_core import errors

ACTIONS = (
    ("ALL", "All", "Select all Gaussians"),
    ("NONE", "None", "Deselect all Gaussians"),
    ("INVERT", "Invert", "Select the Gaussians that are not selected"),
)


class R5DGS_OT_select_gaussians(polls.NeedsScene, bpy.types.Operator):
    """Select all Gaussians of the active scene, none, or those that are not selected"""

    bl_idname = "r5dgs.select_gaussians"
    bl_label = "Select Gaussians"
    bl_options = {"REGISTER", "UNDO"}

    action: EnumProperty(name="Action", description="Change of the selection", items=ACTIONS)

    def execute(self, context):
        def masks(members):
            for cloud in members:
                before = selected_points.mask(cloud.data)
                yield ~before if self.action == "INVERT" else np.full(len(before), self.action == "ALL")

        try:
            count = selected_points.select(loaded_scenes.active_collection(context), "SET", masks)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{plural.of(count, 'Gaussian')} selected")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_select_gaussians,)
