"""Select Floaters operator: Gaussians that meet a criterion of the panel Clean Up."""

import bpy
from bpy.props import EnumProperty

from ..r5dgs_addon.clean_up import criteria, selected_points
from ..r5dgs_addon.scene import loaded_scenes, polls
from ..r5dgs_addon.ui import plural
from ..r5dgs_core import errors


class R5DGS_OT_select_floaters(polls.NeedsScene, bpy.types.Operator):
    """Select the Gaussians that meet at least one of the criteria above"""

    bl_idname = "r5dgs.select_floaters"
    bl_label = "Select Floaters"
    bl_options = {"REGISTER", "UNDO"}

    mode: EnumProperty(name="Mode", description="Change of the selection", items=selected_points.MODES)

    def execute(self, context):
        try:
            count = criteria.select(context, loaded_scenes.active_collection(context), self.mode)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{plural.of(count, 'Gaussian')} selected")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_select_floaters,)
