"""Load R5DGS Scene: sidebar, File > Import, drag and drop, ``bpy.ops.r5dgs.load_scene(filepath=...)``."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, StringProperty

from ..r5dgs_addon import keyframes, objects
from ..r5dgs_core import errors
from ..r5dgs_core.scene import scene_file

CONVENTIONS = (
    ("FILE", "From the File", "The convention that the file records"),
    ("blender", "Blender (Z up)", "Data sets made in Blender, such as those of D-NeRF and NVFi"),
    ("colmap", "COLMAP (Y down)", "Structure from motion: x right, y down, z forward"),
    ("opengl", "OpenGL (Y up)", "x right, y up, z backward"),
)


class R5DGS_OT_load_scene(bpy.types.Operator):
    """Load a scene of named, moving objects made of Gaussians"""

    bl_idname = "r5dgs.load_scene"
    bl_label = "Load Scene"
    bl_options = {"REGISTER", "UNDO", "PRESET"}

    filepath: StringProperty(name="File", description="The .r5dgs file", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default="*.r5dgs", options={"HIDDEN"})
    world_convention: EnumProperty(
        name="World Axes", description="Axes of the scene's world", items=CONVENTIONS, default="FILE"
    )
    frame_zero: FloatProperty(name="Frame of Time 0", description="Frame at which the scene time is 0", default=1.0)
    t_end: FloatProperty(
        name="Extrapolate Until",
        description="Scene time up to which motion is extrapolated; 0 for a third of the observed span, at least to 1",
        default=0.0,
        min=0.0,
    )
    key_tolerance: FloatProperty(
        name="Key Tolerance",
        description="Largest error of the keys, as a fraction of the scene's size; larger gives fewer keys to edit",
        default=keyframes.TOLERANCE,
        min=1e-7,
        max=0.1,
        precision=6,
    )
    fit_timeline: BoolProperty(
        name="Fit Timeline", description="Set the frame range and mark the last observed time", default=True
    )
    view_dependence: BoolProperty(
        name="View Dependence", description="Store how colours change with the viewing direction", default=True
    )

    @classmethod
    def poll(cls, context):
        if context.mode != "OBJECT":
            cls.poll_message_set("Switch to Object Mode first")
            return False
        return True

    def invoke(self, context, event):
        if self.filepath:  # dropped on the window
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        path = Path(bpy.path.abspath(self.filepath))
        options = objects.Options(
            world_convention="" if self.world_convention == "FILE" else self.world_convention,
            frame_zero=self.frame_zero,
            t_end=self.t_end or None,
            key_tolerance=self.key_tolerance,
            fit_timeline=self.fit_timeline,
            view_dependence=self.view_dependence,
        )
        try:
            scene = scene_file.read(path)
            collection = objects.build(context, scene, path, options)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        named = sum(entry.object_id > 0 for entry in collection.r5dgs.table)
        self.report({"INFO"}, f"{path.name}: {len(scene.means)} Gaussians, {named} objects")
        if scene.residual_rows is not None:  # one matrix for each group is all that anchors can say
            count = len(scene.residual_rows)
            self.report({"WARNING"}, f"{count} Gaussians bend while observed; here they move with their group alone")
        return {"FINISHED"}

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        for name in ("world_convention", "frame_zero", "t_end", "key_tolerance", "fit_timeline", "view_dependence"):
            layout.prop(self, name)


class R5DGS_FH_scene(bpy.types.FileHandler):
    """Drag and drop of .r5dgs files."""

    bl_idname = "R5DGS_FH_scene"
    bl_label = "R5DGS Scene"
    bl_import_operator = "r5dgs.load_scene"
    bl_file_extensions = ".r5dgs"

    @classmethod
    def poll_drop(cls, context):
        return context.area is not None and context.area.type in {"VIEW_3D", "OUTLINER"}


CLASSES = (R5DGS_OT_load_scene, R5DGS_FH_scene)
