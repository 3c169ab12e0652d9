"""Load Scene operator: sidebar, File > Import, drag and drop, or ``bpy.ops.r5dgs.load_scene(filepath=...)``."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, StringProperty

from ..r5dgs_addon import build_scene
from ..r5dgs_addon.motion import keyframes, physics, warnings
from ..r5dgs_addon.scene import captured_images, loaded_scenes, viewport_display
from ..r5dgs_addon.ui import plural, stepwise_operator
from ..r5dgs_core import errors
from ..r5dgs_core.scene import scene_file

CONVENTIONS = (
    ("FILE", "From the File", "Convention stored in the file"),
    ("blender", "Blender (Z up)", "Data sets made in Blender, such as those of D-NeRF and NVFi"),
    ("colmap", "COLMAP (Y down)", "Structure from motion: x right, y down, z forward"),
    ("opengl", "OpenGL (Y up)", "x right, y up, z backward"),
)
SH_DEGREES = (
    ("ALL", "As Trained", "All spherical harmonics of the file"),
    ("0", "None", "The same color from all directions; smallest .blend files"),
    ("1", "Degree 1", "3 harmonics in addition to the color"),
    ("2", "Degree 2", "8 harmonics in addition to the color"),
    ("3", "Degree 3", "15 harmonics in addition to the color"),
)
OPTIONS = (
    "world_convention",
    "frame_zero",
    "t_end",
    "key_tolerance",
    "fit_timeline",
    "frame_views",
    "cameras",
    "images",
    "sh_degree",
    "display",
    "bend",
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
    frame_zero: FloatProperty(name="Frame of Time 0", description="Frame of scene time 0", default=1.0)
    t_end: FloatProperty(
        name="Extrapolate Until",
        description="Scene time up to which motion is extrapolated; 0 for a third of the observed span after t_max, "
        "but at least scene time 1",
        default=0.0,
        min=0.0,
    )
    key_tolerance: FloatProperty(
        name="Key Tolerance",
        description="Maximum error of the keys as a fraction of the scene's size; larger values give fewer keys",
        default=keyframes.TOLERANCE,
        min=1e-7,
        max=0.1,
        precision=6,
    )
    fit_timeline: BoolProperty(
        name="Fit Timeline", description="Set the frame range, and mark the last observed time and events", default=True
    )
    sh_degree: EnumProperty(
        name="View Dependence",
        description="Degree of the stored dependence of colors on the viewing direction",
        items=SH_DEGREES,
        default="ALL",
    )
    frame_views: BoolProperty(
        name="Frame Views", description="Look at the scene from a captured camera in all 3D views", default=True
    )
    cameras: BoolProperty(
        name="Captured Cameras",
        description="Create the data set's cameras, and use the best one unless this file uses a camera of its own",
        default=True,
    )
    images: StringProperty(
        name="Captured Images",
        description="Folder of the data set whose images captured cameras show as backgrounds; empty for none",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )
    display: EnumProperty(
        name="Display",
        description="Representation of Gaussians in viewports",
        items=viewport_display.ITEMS,
        default=viewport_display.SPLATS,
    )
    bend: BoolProperty(
        name="Play Bending",
        description="Play the bending of objects from the motion of their single Gaussians; switches on Lock Interface",
        default=True,
    )

    @classmethod
    def poll(cls, context):
        if context.mode != "OBJECT":
            cls.poll_message_set("Switch to Object Mode first")
            return False
        if context.scene.library is not None:
            cls.poll_message_set("This Blender scene is linked from another file: switch to a local scene first")
            return False
        return True

    def invoke(self, context, event):
        if self.filepath:  # dropped on the window
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        if not self.filepath:
            self.report({"ERROR"}, "No file given: choose a .r5dgs file")
            return {"CANCELLED"}
        path = Path(bpy.path.abspath(self.filepath))
        options = build_scene.Options(
            world_convention="" if self.world_convention == "FILE" else self.world_convention,
            frame_zero=self.frame_zero,
            t_end=self.t_end or None,
            key_tolerance=self.key_tolerance,
            fit_timeline=self.fit_timeline,
            sh_degree=3 if self.sh_degree == "ALL" else int(self.sh_degree),
            frame_views=self.frame_views,
            cameras=self.cameras,
            display=self.display,
            play_residuals=self.bend,
        )
        try:
            with stepwise_operator.cursor(context) as progress:
                progress(0.1)
                scene = scene_file.read(path)
                progress(0.4)
                collection = build_scene.build(context, scene, path, options)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if self.images and self.cameras and scene.cameras:
            try:
                captured_images.show(collection, self.images, context.scene.frame_current_final)
            except errors.R5dgsError as error:
                self.report({"WARNING"}, str(error))
        named = sum(entry.object_id > 0 for entry in collection.r5dgs.table)
        self.report(
            {"INFO"}, f"{path.name}: {plural.of(len(scene.gaussians.means), 'Gaussian')}, {plural.of(named, 'object')}"
        )
        if named == 0:
            self.report(
                {"WARNING"}, f"{path.name} contains only a background, no objects; train with masks to get objects"
            )
        doubtful = warnings.lines(collection)
        if doubtful:
            self.report({"WARNING"}, plural.names(doubtful))
        too_fast = physics.too_fast(loaded_scenes.members(collection, "ANCHOR"))
        if too_fast:
            self.report({"WARNING"}, too_fast)
        if scene.residuals is not None and not self.bend:
            count = plural.of(len(scene.residuals.rows), "Gaussian", "bend")
            self.report({"WARNING"}, f"{count} in the observed time; shown rigid, unless Exact Mode is on")
        return {"FINISHED"}

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        for name in OPTIONS:
            layout.prop(self, name)


class R5DGS_FH_scene(bpy.types.FileHandler):
    """File handler for drag and drop of .r5dgs files."""

    bl_idname = "R5DGS_FH_scene"
    bl_label = "R5DGS Scene"
    bl_import_operator = "r5dgs.load_scene"
    bl_file_extensions = ".r5dgs"

    @classmethod
    def poll_drop(cls, context):
        return context.area is not None and context.area.type in {"VIEW_3D", "OUTLINER"}


CLASSES = (R5DGS_OT_load_scene, R5DGS_FH_scene)
