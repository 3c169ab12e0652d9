"""*Export* panel, and the export formats in File > Export."""

import bpy

from ...r5dgs_core.formats import registry
from ..worker import export_formats
from . import sidebar

FORMATS = {  # operator and icon of the formats that have their own, by name
    "ply": ("r5dgs.export_ply", "POINTCLOUD_DATA"),
    "cameras": ("r5dgs.export_cameras", "CAMERA_DATA"),
}


def draw_formats(layout: bpy.types.UILayout, in_menu: bool = False) -> None:
    """Draw a button for each format of the registry, disabled if neither Blender nor the worker can write it.

    Args:
        layout: Layout of a panel or menu.
        in_menu: True for Blender's own menus: labels begin with R5DGS, without icons.
    """
    for name in registry.MODULES:
        found = registry.get(name)
        row = layout.row()
        row.enabled = export_formats.why_unavailable(found) is None
        operator, icon = FORMATS.get(name, ("r5dgs.export_format", "EXPORT"))
        label = f"{found.label} ({found.suffix})"
        button = row.operator(operator, text=f"R5DGS {label}" if in_menu else label, icon="NONE" if in_menu else icon)
        if name not in FORMATS:
            button.format = name


class R5DGS_PT_export(sidebar.WithScene, bpy.types.Panel):
    """Export what Blender shows to other tools."""

    bl_idname = "R5DGS_PT_export"
    bl_label = "Export"
    manual = "export"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        column = self.layout.column()
        draw_formats(column)
        column.operator("r5dgs.export_scene", text="Edited Scene (.r5dgs)", icon="FILE_TICK")
        column.operator("r5dgs.export_masks", text="Object Masks", icon="MOD_MASK")


CLASSES = (R5DGS_PT_export,)
