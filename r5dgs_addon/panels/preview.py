"""Panel *Preview*."""

import bpy

from .. import engine, figures, live_preview, worker, worker_check
from . import render, sidebar


class R5DGS_PT_preview(sidebar.WithScene, bpy.types.Panel):
    """Render what Blender shows in the worker."""

    bl_idname = "R5DGS_PT_preview"
    bl_label = "Preview"

    def draw(self, context):
        layout = self.layout
        row = layout.row(align=True)
        row.operator("r5dgs.preview", icon="RENDER_STILL")
        row.operator("r5dgs.live_preview", text="Live", icon="PLAY", depress=live_preview.running())
        if live_preview.message():
            layout.label(text=live_preview.message(), icon="ERROR")
        if worker.notice():
            layout.label(text=worker.notice().capitalize(), icon="SORTTIME")
        if figures.speed():
            column = layout.column(align=True)
            column.label(text=figures.speed(), icon="TIME")
            for line in figures.errors():
                column.label(text=line[0].upper() + line[1:], icon="BLANK1")
        if context.scene.camera is None:
            layout.label(text="The scene has no camera", icon="INFO")
        if context.scene.render.engine != engine.ENGINE:
            layout.operator("r5dgs.use_engine", icon="SCENE")
        else:
            render.draw_loss(layout, context.scene)
        worker_check.draw(layout, context)


CLASSES = (R5DGS_PT_preview,)
