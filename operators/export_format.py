"""Export operator: the active scene with its edits in any format of `r5dgs export`."""

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, StringProperty

from ..r5dgs_addon.export import formats, frame_range, gaussians
from ..r5dgs_addon.scene import loaded_scenes, polls
from ..r5dgs_addon.ui import stepwise_operator
from ..r5dgs_addon.worker import export_formats
from ..r5dgs_core.formats import registry

_items = []  # referenced here, because Blender keeps no reference to the strings


def _formats(operator, context):
    found = [registry.get(name) for name in registry.MODULES]
    _items[:] = [
        (format.name, format.label, export_formats.why_unavailable(format) or format.summary) for format in found
    ]
    return _items


class R5DGS_OT_export_format(polls.NeedsScene, stepwise_operator.Stepwise, bpy.types.Operator):
    """Export the active scene with its edits for other tools"""

    bl_idname = "r5dgs.export_format"
    bl_label = "Export"
    bl_options = {"REGISTER", "PRESET"}

    filepath: StringProperty(name="File", description="Output file", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(options={"HIDDEN", "SKIP_SAVE"})
    check_existing: BoolProperty(default=True, options={"HIDDEN"})
    format: EnumProperty(name="Format", description="Output format", items=_formats, options={"HIDDEN", "SKIP_SAVE"})
    which: EnumProperty(name="Objects", description="Objects to export", items=gaussians.WHICH, default="VISIBLE")
    frames: EnumProperty(name="Frames", description="Frames to export", items=frame_range.FRAMES)
    frame_step: IntProperty(
        name="Frame Step", description="Number of frames from one exported frame to the next", default=1, min=1
    )

    @classmethod
    def description(cls, context, properties):
        format = registry.get(properties.format)
        return export_formats.why_unavailable(format) or f"{cls.__doc__}. {format.summary}"

    def suggest(self, context):
        suffix = registry.get(self.format).suffix
        self.filter_glob = f"*{suffix}"
        self.suggest_file("scene", suffix)
        return False

    def steps(self, context):
        format = export_formats.usable(self.format)
        return formats.steps(
            context,
            loaded_scenes.active_collection(context),
            self.target_file(format.suffix),
            format,
            self.which,
            every=self.frames == "RANGE",
            step=self.frame_step,
        )

    def draw(self, context):
        frame_range.draw_properties(self, "which", "frames", "frame_step")


CLASSES = (R5DGS_OT_export_format,)
