"""*Preview* panel."""

import bpy

from ..engine import engine, live_preview, render_stats
from ..ui import status_bar, worker_status
from ..worker import jobs
from . import render, sidebar


class R5DGS_PT_preview(sidebar.WithScene, bpy.types.Panel):
    """Render the scene in the worker."""

    bl_idname = "R5DGS_PT_preview"
    bl_label = "Preview"
    manual = "rendering"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        layout = self.layout
        row = layout.row(align=True)
        row.operator("r5dgs.preview", icon="RENDER_STILL")
        row.operator("r5dgs.live_preview", text="Live", icon="PLAY", depress=live_preview.running())
        if live_preview.message():
            status_bar.wrapped(layout, context, live_preview.message(), "ERROR")
        if jobs.notice():
            status_bar.wrapped(layout, context, jobs.notice().capitalize(), "SORTTIME")
        if render_stats.speed():
            column = layout.column(align=True)
            status_bar.wrapped(column, context, render_stats.speed(), "TIME")
            for line in render_stats.errors():
                status_bar.wrapped(column, context, line[0].upper() + line[1:], "BLANK1")
        if context.scene.camera is None:
            layout.label(text="The scene has no camera", icon="INFO")
        if context.scene.render.engine != engine.ENGINE:
            layout.operator("r5dgs.use_engine", icon="SCENE")
        else:
            render.draw_loss(layout, context.scene)
        worker_status.draw(layout, context)


CLASSES = (R5DGS_PT_preview,)
