"""Operators of the extension, one user action per file. Each module lists its classes in ``CLASSES``."""

import bpy

from ..r5dgs_addon.ui import stepwise_operator
from . import (
    add_alias,
    allow_scene_file,
    capture_dataset,
    check_worker,
    delete_object,
    duplicate_object,
    exact_mode,
    export_cameras,
    export_masks,
    export_ply,
    export_scene,
    extrapolate_until,
    fit_timeline,
    isolate,
    live_preview,
    load_scene,
    pivot_to_cursor,
    preview,
    re_extrapolate,
    recolor,
    remove_alias,
    rename_object,
    replace_motion,
    reset_color,
    reset_motion,
    select_by_prompt,
    select_object,
    set_display,
    show_colors_as_trained,
    show_confidence,
    simplify_keys,
    unisolate,
    use_engine,
)

MODULES = (
    load_scene,
    allow_scene_file,
    fit_timeline,
    set_display,
    select_by_prompt,
    simplify_keys,
    select_object,
    isolate,
    unisolate,
    rename_object,
    add_alias,
    remove_alias,
    recolor,
    reset_color,
    re_extrapolate,
    reset_motion,
    pivot_to_cursor,
    extrapolate_until,
    replace_motion,
    duplicate_object,
    delete_object,
    exact_mode,
    show_confidence,
    preview,
    live_preview,
    use_engine,
    show_colors_as_trained,
    check_worker,
    export_ply,
    export_scene,
    export_masks,
    export_cameras,
    capture_dataset,
)


def _menu_import(menu, context):
    menu.layout.operator(load_scene.R5DGS_OT_load_scene.bl_idname, text="R5DGS Scene (.r5dgs)")


def _menu_export(menu, context):
    gaussians = f"R5DGS {export_ply.FORMAT.label} ({export_ply.FORMAT.suffix})"
    menu.layout.operator(export_ply.R5DGS_OT_export_ply.bl_idname, text=gaussians)
    menu.layout.operator(export_scene.R5DGS_OT_export_scene.bl_idname, text="R5DGS Edited Scene (.r5dgs)")
    menu.layout.operator(export_masks.R5DGS_OT_export_masks.bl_idname, text="R5DGS Object Masks")
    menu.layout.operator(export_cameras.R5DGS_OT_export_cameras.bl_idname, text="R5DGS Cameras")
    menu.layout.operator(capture_dataset.R5DGS_OT_capture_dataset.bl_idname, text="R5DGS Training Data Set")


MENUS = ((bpy.types.TOPBAR_MT_file_import, _menu_import), (bpy.types.TOPBAR_MT_file_export, _menu_export))


def register():
    """Register all classes, and the entries of File > Import and File > Export."""
    for module in MODULES:
        for cls in module.CLASSES:
            bpy.utils.register_class(cls)
    for menu, draw in MENUS:
        menu.append(draw)


def unregister():
    """Stop running operators, and undo `register` in reverse order."""
    stepwise_operator.stop_all(bpy.context)
    for menu, draw in MENUS:
        menu.remove(draw)
    for module in reversed(MODULES):
        for cls in reversed(module.CLASSES):
            bpy.utils.unregister_class(cls)
