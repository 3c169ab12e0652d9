"""Registrations of the extension in Blender."""

import inspect
import sys


def traces(bpy):
    """Registrations of the extension in Blender: classes, properties, handlers, timers, menus, keymaps."""
    found = {name for name in dir(bpy.types) if "R5DGS" in name.upper()}
    for owner in ("Object", "Collection", "Scene", "WindowManager", "Material", "Camera", "PointCloud"):
        properties = getattr(bpy.types, owner).bl_rna.properties
        found |= {f"{owner}.{p.identifier}" for p in properties if "r5dgs" in p.identifier.lower()}
    for name in dir(bpy.app.handlers):
        listening = getattr(bpy.app.handlers, name)
        if isinstance(listening, list):
            found |= {f"{name}: {f}" for f in listening if getattr(f, "__module__", "").startswith("r5dgs.")}
    for name, module in list(sys.modules.items()):
        if name.startswith(("r5dgs.r5dgs_addon", "r5dgs.operators")):
            functions = [value for value in vars(module).values() if inspect.isfunction(value)]
            found |= {f"timer: {f}" for f in functions if bpy.app.timers.is_registered(f)}
    for name in dir(bpy.types):
        drawn = getattr(getattr(getattr(bpy.types, name), "draw", None), "_draw_funcs", ())
        found |= {f"{name}: {f}" for f in drawn if f.__module__.startswith("r5dgs.")}
    configurations = bpy.context.window_manager.keyconfigs
    for configuration in configurations:
        for keymap in configuration.keymaps:
            found |= {
                f"{keymap.name}: {item.idname}" for item in keymap.keymap_items if item.idname.startswith("r5dgs.")
            }
    return found
