"""The sidebar of the 3D view: tab R5DGS."""

import bpy

from . import objects, timeline, worker

TAB = "R5DGS"


class _Sidebar:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = TAB


class _WithScene(_Sidebar):
    """Panels that are shown once a scene is loaded."""

    @classmethod
    def poll(cls, context):
        return objects.active_collection(context) is not None


class R5DGS_PT_scene(_Sidebar, bpy.types.Panel):
    """Load a scene and see what it holds."""

    bl_idname = "R5DGS_PT_scene"
    bl_label = "Scene"

    def draw(self, context):
        layout = self.layout
        layout.operator("r5dgs.load_scene", text="Load R5DGS Scene", icon="IMPORT")
        collection = objects.active_collection(context)
        if collection is None:
            layout.label(text="No scene loaded", icon="INFO")
            return
        state = collection.r5dgs
        times = timeline.of_collection(collection)
        t = times.time(context.scene.frame_current_final)
        column = layout.column(align=True)
        named = sum(entry.object_id > 0 for entry in state.table)
        column.label(
            text=f"{state.scene_name}: {named} objects, {state.gaussians:,} Gaussians", icon="OUTLINER_COLLECTION"
        )
        column.label(text=f"Observed {times.t_start:.3g} to {times.t_max:.3g}, keys to {times.t_end:.3g}", icon="TIME")
        if t > times.t_max + 1e-6:
            column.label(text=f"t = {t:.3f}: extrapolated by {t - times.t_max:.3f}", icon="FORWARD")
        else:
            column.label(text=f"t = {t:.3f}: observed", icon="HIDE_OFF")
        layout.prop(state, "filepath")


class R5DGS_PT_prompt(_WithScene, bpy.types.Panel):
    """Select objects by words."""

    bl_idname = "R5DGS_PT_prompt"
    bl_label = "Select by Prompt"

    def draw(self, context):
        layout = self.layout
        session = context.window_manager.r5dgs
        layout.prop(session, "prompt", text="", icon="VIEWZOOM")
        row = layout.row(align=True)
        for mode, text in (("SET", "Select"), ("ADD", "Add"), ("SUBTRACT", "Subtract")):
            action = row.operator("r5dgs.select_by_prompt", text=text)
            action.mode = mode
            action.text = session.prompt
        if not session.asked:
            return
        box = layout.box().column(align=True)
        if not session.matches:
            box.label(text=f"Nothing matches '{session.asked}'", icon="INFO")
        for match in session.matches:
            line = box.row()
            line.label(text=match.name, icon="OUTLINER_OB_POINTCLOUD")
            line.label(text=match.why)
            line.label(text=f"{match.score:.2f}")


class R5DGS_PT_preview(_WithScene, bpy.types.Panel):
    """Render what Blender shows in the worker."""

    bl_idname = "R5DGS_PT_preview"
    bl_label = "Preview"

    def draw(self, context):
        layout = self.layout
        layout.operator("r5dgs.preview", icon="RENDER_STILL")
        if worker.notice():
            layout.label(text=worker.notice().capitalize(), icon="SORTTIME")
        session = context.window_manager.r5dgs
        if session.preview_size:
            layout.label(text=f"{session.preview_size} in {session.preview_ms:.0f} ms", icon="TIME")
        if context.scene.camera is None:
            layout.label(text="The scene has no camera", icon="INFO")


class R5DGS_PT_capture(_Sidebar, bpy.types.Panel):
    """Make training data from this Blender scene."""

    bl_idname = "R5DGS_PT_capture"
    bl_label = "Capture"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        return hasattr(bpy.types, "R5DGS_OT_capture_dataset")

    def draw(self, context):
        self.layout.operator("r5dgs.capture_dataset", text="Capture Data Set", icon="CAMERA_DATA")


CLASSES = (R5DGS_PT_scene, R5DGS_PT_prompt, R5DGS_PT_preview, R5DGS_PT_capture)


def register():
    """Register the panels."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister():
    """Undo `register`."""
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
