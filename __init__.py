"""R5DGS as a Blender extension. The repository root is the extension; nothing is imported before `register`."""


def register():
    """Register the add-on's services, then its operators."""
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
