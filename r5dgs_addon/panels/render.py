"""Panels of the R5DGS engine in the render and view layer properties."""

import bpy

from ..color import display_to_linear, inverse_loss
from ..engine import engine, mesh_merge, render_notes
from ..ui import status_bar
from ..worker import jobs


def draw_loss(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """Draw the colour loss under the view transform once it has been measured."""
    loss = inverse_loss.known(scene)
    if loss is not None:
        poor, text = loss.psnr < inverse_loss.ENOUGH_DB, inverse_loss.note(loss)
        text = f"{scene.view_settings.view_transform}: {text}"
        status_bar.wrapped(layout, bpy.context, text, "ERROR" if poor else "INFO")
        if poor:
            layout.operator("r5dgs.show_colors_as_trained", icon="COLOR")


class _OfEngine:
    """Mixin for panels of the properties editor that belong to the R5DGS engine."""

    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    COMPAT_ENGINES = {engine.ENGINE}

    @classmethod
    def poll(cls, context):
        return context.engine in cls.COMPAT_ENGINES


class R5DGS_PT_render(_OfEngine, bpy.types.Panel):
    """Settings of the engine, and warnings about colour management."""

    bl_idname = "R5DGS_PT_render"
    bl_label = "R5DGS"
    bl_context = "render"

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        scene = context.scene
        objections = display_to_linear.objections(scene)
        if objections:
            box = layout.box().column(align=True)
            text = f"Colors are not as trained: {', '.join(objections)}"
            status_bar.wrapped(box, context, text, "ERROR")
            box.operator("r5dgs.show_colors_as_trained", icon="COLOR")
        for note in render_notes.of(scene):
            status_bar.wrapped(layout, context, note, "INFO")
        settings = scene.r5dgs_render
        column = layout.column()
        column.prop(settings, "as_trained")
        inverse = display_to_linear.inverse(scene)
        if inverse is not None and not objections:
            text = f"{scene.view_settings.view_transform} is inverted for Gaussians"
            status_bar.wrapped(column, context, text, "CHECKMARK")
            draw_loss(column, scene)
            if inverse.reach < display_to_linear.WIDE:
                status_bar.wrapped(column, context, "Very saturated colors are paler than trained")
        column.prop(settings, "sky")
        column.prop(scene.render, "film_transparent", text="Transparent")
        column.prop(settings, "moving")
        row = column.row()
        has_lens = scene.camera is not None and scene.camera.type == "CAMERA" and scene.camera.data.dof.use_dof
        row.active = has_lens or scene.render.use_motion_blur
        row.prop(settings, "samples")
        if jobs.notice():
            status_bar.wrapped(layout, context, jobs.notice().capitalize(), "SORTTIME")


class R5DGS_PT_merge(_OfEngine, bpy.types.Panel):
    """Meshes of another engine among the Gaussians."""

    bl_idname = "R5DGS_PT_merge"
    bl_parent_id = "R5DGS_PT_render"
    bl_label = "Meshes"
    bl_context = "render"

    def draw(self, context):
        layout = self.layout
        meshes = mesh_merge.of(context.scene)
        if meshes is None:
            layout.operator("r5dgs.merge_with_meshes", icon="NODE_COMPOSITING")
            return
        text = f"Merged with the scene '{meshes.name}', which has the meshes' render settings"
        status_bar.wrapped(layout, context, text, "CHECKMARK")
        row = layout.row(align=True)
        row.operator("r5dgs.merge_with_meshes", text="Merge Again", icon="FILE_REFRESH").engine = meshes.render.engine
        row.operator("r5dgs.stop_merging", icon="X")
        layout.operator("r5dgs.add_shadows", icon="SHADING_RENDERED")


class R5DGS_PT_passes(_OfEngine, bpy.types.Panel):
    """Passes supported by the engine."""

    bl_idname = "R5DGS_PT_passes"
    bl_label = "Passes"
    bl_context = "view_layer"

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column(heading="Data")
        column.prop(context.view_layer, "use_pass_z", text="Depth")
        column.prop(context.view_layer, "use_pass_object_index", text="Object Index")
        column = layout.column(heading="Cryptomatte")
        column.prop(context.view_layer, "use_pass_cryptomatte_object", text="Object")
        row = column.row()
        row.active = context.view_layer.use_pass_cryptomatte_object
        row.prop(context.view_layer, "pass_cryptomatte_depth", text="Levels")


CLASSES = (R5DGS_PT_render, R5DGS_PT_merge, R5DGS_PT_passes)
