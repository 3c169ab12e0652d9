"""Export Cameras: Blender's cameras as transforms.json or COLMAP text."""

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, StringProperty

from ..r5dgs_addon.export import cameras, frame_range, gaussians
from ..r5dgs_addon.ui import stepwise_operator


class R5DGS_OT_export_cameras(stepwise_operator.Running, bpy.types.Operator):
    """Write cameras with lens, pose and time for radiance-field tools"""

    bl_idname = "r5dgs.export_cameras"
    bl_label = "Export Cameras"
    bl_options = {"REGISTER", "PRESET"}

    directory: StringProperty(
        name="Folder", description="Folder that the files go into", subtype="DIR_PATH", options={"SKIP_SAVE"}
    )
    filter_folder: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    which: EnumProperty(name="Cameras", description="What is exported", items=cameras.WHICH)
    format: EnumProperty(name="Format", description="What is written", items=cameras.FORMATS)
    frames: EnumProperty(name="Frames", description="When it is exported", items=frame_range.FRAMES, default="RANGE")
    frame_step: IntProperty(name="Frame Step", description="Frames from one view to the next", default=1, min=1)
    axes: EnumProperty(name="Axes", description="World that the cameras are in", items=gaussians.AXES)

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
