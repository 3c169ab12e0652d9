"""Export Gaussians operator: visible Gaussians as 3D Gaussian Splatting files."""

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, StringProperty

from ..r5dgs_addon.export import frame_range, gaussians
from ..r5dgs_addon.scene import loaded_scenes, selection
from ..r5dgs_addon.ui import stepwise_operator
from ..r5dgs_core.formats import registry

FORMAT = registry.get("ply")


class R5DGS_OT_export_ply(stepwise_operator.Stepwise, bpy.types.Operator):
    """Export Gaussians with all edits and at their current positions as PLY files for other splat tools"""

    bl_idname = "r5dgs.export_ply"
    bl_label = "Export Gaussians"
    bl_description = f"{__doc__}. {FORMAT.summary}"
    bl_options = {"REGISTER", "PRESET"}

    filepath: StringProperty(name="File", description="The .ply file", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default=f"*{FORMAT.suffix}", options={"HIDDEN"})
    check_existing: BoolProperty(default=True, options={"HIDDEN"})
    which: EnumProperty(name="Objects", description="Objects to export", items=gaussians.WHICH, default="VISIBLE")
    frames: EnumProperty(name="Frames", description="Frames to export", items=frame_range.FRAMES)
    frame_step: IntProperty(
        name="Frame Step", description="Number of frames from one file to the next", default=1, min=1
    )
    axes: EnumProperty(name="Axes", description="Coordinate system of the positions", items=gaussians.AXES)
    plain: BoolProperty(
        name="Plain",
        description="Omit object ids and identity encodings, for tools that reject unknown columns",
        default=False,
    )

    @classmethod
    def poll(cls, context):
        if not loaded_scenes.scene_collections():  # scenes that are only instanced are exported, too
            cls.poll_message_set(selection.NO_SCENE)
            return False
        return True

    def suggest(self, context):
        self.suggest_file("gaussians", FORMAT.suffix)
        return False

    def steps(self, context):
        return gaussians.ply_steps(
            context,
            self.target_file(FORMAT.suffix),
            self.which,
            axes=self.axes,
            plain=self.plain,
            every=self.frames == "RANGE",
            step=self.frame_step,
        )

    def draw(self, context):
        frame_range.draw_properties(self, "which", "frames", "frame_step", "axes", "plain")


CLASSES = (R5DGS_OT_export_ply,)
