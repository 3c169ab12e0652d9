"""*Clean Up* panel: select single Gaussians by criteria or by hand, delete or assign them."""

import bpy

from ..clean_up import criteria, selected_points, tools
from ..scene import loaded_scenes, object_names, selection
from ..ui import plural, status_bar
from . import sidebar

ROWS = (  # switch and values of each criterion
    ("by_opacity", "opacity"),
    ("by_size", "size"),
    ("by_isolation", "neighbors", "isolation"),
    ("by_distance", "distance"),
    ("by_box", "box", "side"),
)


class R5DGS_PT_clean_up(sidebar.WithScene, bpy.types.Panel):
    """Select single Gaussians, and delete them or assign them to an object."""

    bl_idname = "R5DGS_PT_clean_up"
    bl_label = "Clean Up"
    manual = "clean_up"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        layout, collection = self.layout, loaded_scenes.active_collection(context)
        row = layout.row(align=True)
        row.operator("wm.tool_set_by_id", text="Lasso", icon="SELECT_SET").name = tools.LASSO
        row.operator("wm.tool_set_by_id", text="Brush", icon="BRUSH_DATA").name = tools.BRUSH
        _draw_criteria(layout, context, criteria.of(collection))
        count = selected_points.count(collection)
        layout.label(text=f"{plural.of(count, 'Gaussian')} selected", icon="RESTRICT_SELECT_OFF")
        row = layout.row(align=True)
        for action, text in (("ALL", "All"), ("NONE", "None"), ("INVERT", "Invert")):
            row.operator("r5dgs.select_gaussians", text=text).action = action
        column = layout.column(align=True)
        column.operator("r5dgs.delete_gaussians", icon="TRASH")
        active = context.view_layer.objects.active
        owner = None if active is None else selection.owner([collection], active)
        name = "Object" if owner is None else object_names.names(collection).get(owner[1], "Object")
        row = column.row(align=True)
        row.enabled = owner is not None
        row.operator("r5dgs.assign_gaussians", text=f"Assign to {name}", icon="OUTLINER_OB_POINTCLOUD")


def _draw_criteria(layout: bpy.types.UILayout, context: bpy.types.Context, state) -> None:
    """Draw the criteria of floaters."""
    box = layout.box()
    row = box.row(align=True)
    row.prop(state, "scope", text="")
    row.prop(state, "live", icon="HIDE_OFF", toggle=True)
    for switch, *values in ROWS:
        row = box.row(align=True)
        row.prop(state, switch, text="")
        column = row.column(align=True)
        column.enabled = getattr(state, switch)
        for value in values:
            column.prop(state, value)
    box.operator("r5dgs.add_crop_box", icon="CUBE")
    if state.problem:
        status_bar.wrapped(box, context, state.problem, "ERROR")
    box.operator("r5dgs.select_floaters", icon="RESTRICT_SELECT_OFF").mode = "SET"


CLASSES = (R5DGS_PT_clean_up,)
