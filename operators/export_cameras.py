"""Export Cameras operator: Blender's cameras as transforms.json or COLMAP text model."""

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, StringProperty

from ..r5dgs_addon.export import cameras, frame_range, gaussians
from ..r5dgs_addon.ui import stepwise_operator
from ..r5dgs_core.formats import registry


class R5DGS_OT_export_cameras(stepwise_operator.Stepwise, bpy.types.Operator):
    """Export cameras with lens, pose and time for radiance field tools"""

    bl_idname = "r5dgs.export_cameras"
    bl_label = "Export Cameras"
    bl_description = f"{__doc__}. {registry.get('cameras').summary}"
    bl_options = {"REGISTER", "PRESET"}

    directory: StringProperty(name="Folder", description="Output folder", subtype="DIR_PATH", options={"SKIP_SAVE"})
    filter_folder: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    which: EnumProperty(name="Cameras", description="Cameras to export", items=cameras.WHICH)
    format: EnumProperty(name="Format", description="Output format", items=cameras.FORMATS)
    frames: EnumProperty(name="Frames", description="Frames to export", items=frame_range.FRAMES, default="RANGE")
    frame_step: IntProperty(
        name="Frame Step", description="Number of frames from one view to the next", default=1, min=1
    )
    axes: EnumProperty(name="Axes", description="Coordinate system of the cameras", items=gaussians.AXES)

    @classmethod
    def poll(cls, context):
        if not any(obj.type == "CAMERA" for obj in context.scene.objects):
            cls.poll_message_set("Add a camera to the scene first")
            return False
        return True

    def steps(self, context):
        return cameras.steps(
            context,
            self.target_folder(),
            self.which,
            format=self.format,
            axes=self.axes,
            every=self.frames == "RANGE",
            step=self.frame_step,
        )

    def draw(self, context):
        frame_range.draw_properties(self, "which", "format", "frames", "frame_step", "axes")


CLASSES = (R5DGS_OT_export_cameras,)
