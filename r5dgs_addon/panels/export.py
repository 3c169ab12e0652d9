"""*Export* panel."""

import bpy

from . import sidebar

ENTRIES = (
    ("r5dgs.export_ply", "Gaussians (.ply)", "POINTCLOUD_DATA"),
    ("r5dgs.export_scene", "Edited Scene (.r5dgs)", "FILE_TICK"),
    ("r5dgs.export_masks", "Object Masks", "MOD_MASK"),
    ("r5dgs.export_cameras", "Cameras", "CAMERA_DATA"),
)  # fmt: skip


class R5DGS_PT_export(sidebar.WithScene, bpy.types.Panel):
    """Export what Blender shows to other tools."""

    bl_idname = "R5DGS_PT_export"
    bl_label = "Export"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        column = self.layout.column()
        for operator, text, icon in ENTRIES:
            column.operator(operator, text=text, icon=icon)


CLASSES = (R5DGS_PT_export,)
