"""Tools *Lasso Gaussians* and *Brush Gaussians* in the toolbar of 3D views."""

import bpy

LASSO, BRUSH = "r5dgs.lasso_tool", "r5dgs.brush_tool"


def _keymap(operator: str) -> tuple:
    return tuple(
        (operator, {"type": "LEFTMOUSE", "value": "PRESS", **keys}, {"properties": [("mode", mode)]})
        for mode, keys in (("SET", {}), ("ADD", {"shift": True}), ("SUBTRACT", {"ctrl": True}))
    )


class LassoTool(bpy.types.WorkSpaceTool):
    """Lasso of Gaussians."""

    bl_space_type, bl_context_mode = "VIEW_3D", "OBJECT"
    bl_idname, bl_label, bl_icon = LASSO, "Lasso Gaussians", "ops.generic.select_lasso"
    bl_description = "Select the Gaussians inside a lasso.\nShift adds to the selection, Ctrl subtracts from it"
    bl_keymap = _keymap("r5dgs.lasso_gaussians")

    def draw_settings(context, layout, tool):
        layout.prop(tool.operator_properties("r5dgs.lasso_gaussians"), "depth")


class BrushTool(bpy.types.WorkSpaceTool):
    """Brush of Gaussians."""

    bl_space_type, bl_context_mode = "VIEW_3D", "OBJECT"
    bl_idname, bl_label, bl_icon = BRUSH, "Brush Gaussians", "ops.generic.select_circle"
    bl_description = "Select the Gaussians under a brush.\nShift adds to the selection, Ctrl subtracts from it"
    bl_keymap = _keymap("r5dgs.brush_gaussians")

    def draw_settings(context, layout, tool):
        properties = tool.operator_properties("r5dgs.brush_gaussians")
        layout.prop(properties, "radius")
        layout.prop(properties, "depth")


TOOLS = (LassoTool, BrushTool)


def register():
    """Register the tools, if there is a window."""
    if not bpy.app.background:
        for number, tool in enumerate(TOOLS):
            bpy.utils.register_tool(tool, separator=number == 0)


def unregister():
    """Undo `register`."""
    if not bpy.app.background:
        for tool in reversed(TOOLS):
            bpy.utils.unregister_tool(tool)
