"""Panel *Preview*."""

import bpy

from .. import engine, figures, live_preview, windows, worker, worker_check
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
            windows.wrapped(layout, context, live_preview.message(), "ERROR")
        if worker.notice():
            windows.wrapped(layout, context, worker.notice().capitalize(), "SORTTIME")
        if figures.speed():
            column = layout.column(align=True)
            windows.wrapped(column, context, figures.speed(), "TIME")
            for line in figures.errors():
                windows.wrapped(column, context, line[0].upper() + line[1:], "BLANK1")
        if context.scene.camera is None:
            layout.label(text="The scene has no camera", icon="INFO")
        if context.scene.render.engine != engine.ENGINE:
            layout.operator("r5dgs.use_engine", icon="SCENE")
        else:
            render.draw_loss(layout, context.scene)
        worker_check.draw(layout, context)


CLASSES = (R5DGS_PT_preview,)
