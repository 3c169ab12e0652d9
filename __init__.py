"""Entry point of the R5DGS Blender extension, whose root is this repository. Packages are imported in `register`."""


def register():
    """Register the extension's services, then the operators."""
    from . import operators, r5dgs_addon

    r5dgs_addon.register()
    operators.register()
    r5dgs_addon.compat.call_at_exit(unregister)


def unregister():
    """Undo `register` in reverse order."""
    from . import operators, r5dgs_addon

    r5dgs_addon.compat.do_not_call_at_exit(unregister)
    operators.unregister()
    r5dgs_addon.unregister()
