"""*Scene* panel: load a scene and show its contents."""

import bpy

from ..motion import event_markers
from ..scene import captured_cameras, evaluated_points, loaded_scenes, timeline, trust, viewport_display
from ..splats import viewport_splats
from ..ui import plural, status_bar
from . import sidebar


class R5DGS_PT_scene(sidebar.Sidebar, bpy.types.Panel):
    """Load a scene and show its contents."""

    bl_idname = "R5DGS_PT_scene"
    bl_label = "Scene"
    manual = "blender"

    def draw(self, context):
        layout = self.layout
        layout.operator("r5dgs.load_scene", text="Load R5DGS Scene", icon="IMPORT")
        collection = loaded_scenes.active_collection(context)
        if collection is None:
            layout.label(text="No scene loaded", icon="INFO")
            return
        state = collection.r5dgs
        times = timeline.of_collection(collection)
        t = times.time(context.scene.frame_current_final)
        column = layout.column(align=True)
        named = sum(entry.object_id > 0 for entry in state.table)
        column.label(
            text=f"{state.scene_name}: {plural.of(named, 'object')}, {plural.of(state.gaussians, 'Gaussian')}",
            icon="OUTLINER_COLLECTION",
        )
        column.label(text=f"Observed {times.t_start:.3g} to {times.t_max:.3g}, keys to {times.t_end:.3g}", icon="TIME")
        if (origin := loaded_scenes.origin(collection)).any():
            column.label(text=f"Relative to {loaded_scenes.origin_text(origin)}", icon="EMPTY_AXIS")
        if t > times.t_max + 1e-6:
            column.label(text=f"t = {t:.3f}: extrapolated by {t - times.t_max:.3f}", icon="FORWARD")
        else:
            column.label(text=f"t = {t:.3f}: observed", icon="HIDE_OFF")
        for note in evaluated_points.notes(collection):
            status_bar.wrapped(layout, context, note, "ERROR")
        if not (timeline.fits(context.scene, times) and event_markers.shown(context.scene, collection)):
            layout.operator("r5dgs.fit_timeline", icon="TIME")
        layout.operator("r5dgs.view_as_trained", icon="CAMERA_DATA")
        if captured_cameras.all_of(collection):
            row = layout.row(align=True)
            row.operator_menu_enum("r5dgs.use_captured_camera", "camera", text="Camera")
            row.operator("r5dgs.show_captured_images", text="Images", icon="IMAGE_BACKGROUND")
        row = layout.row(align=True)
        for value, name, *_ in viewport_display.ITEMS:
            row.operator("r5dgs.set_display", text=name, depress=state.display == value).display = value
        if viewport_splats.message(context):
            status_bar.wrapped(layout, context, viewport_splats.message(context), "ERROR")
        row = layout.split(factor=0.33)  # beside the field, Blender would truncate the name
        row.label(text="Scene File")
        row.prop(state, "filepath", text="")
        asked = trust.find(collection).asked
        if asked is not None:
            box = layout.box()
            status_bar.wrapped(box, context, f"Not read, outside this .blend's folder: {asked}", "LOCKED")
            row = box.row(align=True)
            row.operator("r5dgs.allow_scene_file").always = False
            row.operator("r5dgs.allow_scene_file", text="Trust Its Folder").always = True


CLASSES = (R5DGS_PT_scene,)
