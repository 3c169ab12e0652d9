"""The user's actions in Blender, one per file; each module lists its classes in ``CLASSES``."""

import bpy

from . import load_scene, preview, select_by_prompt, worker_test

MODULES = (load_scene, select_by_prompt, preview, worker_test)


def _menu_import(menu, context):
    menu.layout.operator(load_scene.R5DGS_OT_load_scene.bl_idname, text="R5DGS Scene (.r5dgs)")


def _menu_export(menu, context):
    if hasattr(bpy.types, "R5DGS_OT_capture_dataset"):
        menu.layout.operator("r5dgs.capture_dataset", text="R5DGS Training Data Set")


def register():
    """Register every class, and the entries of File > Import and File > Export."""
    for module in MODULES:
        for cls in module.CLASSES:
            bpy.utils.register_class(cls)
    bpy.types.TOPBAR_MT_file_import.append(_menu_import)
    bpy.types.TOPBAR_MT_file_export.append(_menu_export)


def unregister():
    """Undo `register` in reverse order."""
    bpy.types.TOPBAR_MT_file_export.remove(_menu_export)
    bpy.types.TOPBAR_MT_file_import.remove(_menu_import)
    for module in reversed(MODULES):
        for cls in reversed(module.CLASSES):
            bpy.utils.unregister_class(cls)
