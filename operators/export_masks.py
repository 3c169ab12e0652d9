"""Export Object Masks operator: the object that each pixel shows, as PNG masks and index EXR."""

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, StringProperty

from ..r5dgs_addon.export import frame_range, masks
from ..r5dgs_addon.scene import polls
from ..r5dgs_addon.ui import stepwise_operator


class R5DGS_OT_export_masks(stepwise_operator.Stepwise, polls.NeedsCamera, bpy.types.Operator):
    """Save masks of the objects that the active camera sees; the worker renders them"""

    bl_idname = "r5dgs.export_masks"
    bl_label = "Export Object Masks"
    bl_options = {"REGISTER", "PRESET"}

    directory: StringProperty(name="Folder", description="Output folder", subtype="DIR_PATH", options={"SKIP_SAVE"})
    filter_folder: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    format: EnumProperty(name="Format", description="Output format", items=masks.FORMATS)
    frames: EnumProperty(name="Frames", description="Frames to export", items=frame_range.FRAMES, default="RANGE")
    frame_step: IntProperty(
        name="Frame Step", description="Number of frames from one file to the next", default=1, min=1
    )

    def steps(self, context):
        return masks.steps(
            context, self.target_folder(), format=self.format, every=self.frames == "RANGE", step=self.frame_step
        )

    def draw(self, context):
        frame_range.draw_properties(self, "format", "frames", "frame_step")


CLASSES = (R5DGS_OT_export_masks,)
