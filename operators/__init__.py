"""Operators of the extension, one user action per file. Each module of this folder lists its classes in ``CLASSES``."""

import importlib
import pkgutil
from types import ModuleType

import bpy

from ..r5dgs_addon.clean_up import tools
from ..r5dgs_addon.panels import export
from ..r5dgs_addon.ui import stepwise_operator


def modules() -> list[ModuleType]:
    """Import the modules of this folder, sorted by name."""
    return [importlib.import_module(f".{found.name}", __package__) for found in pkgutil.iter_modules(__path__)]


def _menu_import(menu, context):
    menu.layout.operator("r5dgs.load_scene", text="R5DGS Scene (.r5dgs)")


def _menu_export(menu, context):
    export.draw_formats(menu.layout, in_menu=True)
    menu.layout.operator("r5dgs.export_scene", text="R5DGS Edited Scene (.r5dgs)")
    menu.layout.operator("r5dgs.export_masks", text="R5DGS Object Masks")
    menu.layout.operator("r5dgs.capture_dataset", text="R5DGS Training Data Set")


def _menu_view(menu, context):
    menu.layout.separator()
    still, whole = "Viewport Render with Splats", "Viewport Render Animation with Splats"
    menu.layout.operator("r5dgs.viewport_render", text=still, icon="RENDER_STILL").animation = False
    menu.layout.operator("r5dgs.viewport_render", text=whole, icon="RENDER_ANIMATION").animation = True


MENUS = (
    (bpy.types.TOPBAR_MT_file_import, _menu_import),
    (bpy.types.TOPBAR_MT_file_export, _menu_export),
    (bpy.types.VIEW3D_MT_view, _menu_view),
)


def register():
    """Register the classes of all modules, their tools, and the entries of the menus."""
    for module in modules():
        for cls in module.CLASSES:
            bpy.utils.register_class(cls)
    tools.register()  # after the operators, because the keymaps of the tools refer to them
    for menu, draw in MENUS:
        menu.append(draw)


def unregister():
    """Stop running operators, and undo `register` in reverse order."""
    stepwise_operator.stop_all(bpy.context)
    for menu, draw in MENUS:
        menu.remove(draw)
    tools.unregister()
    for module in reversed(modules()):
        for cls in reversed(module.CLASSES):
            bpy.utils.unregister_class(cls)
