"""A stand-in for Blender's `UILayout`, which exists only while a window is drawn."""

from types import SimpleNamespace


class Layout:
    """Records texts, and refuses icons, properties, operators and arguments that do not exist.

    Args:
        bpy: Blender.
        said: Where texts, names of properties and names of operators go.
    """

    def __init__(self, bpy, said):
        self.bpy, self.said = bpy, said

    def row(self, **_):
        return Layout(self.bpy, self.said)

    column = box = row = split = grid_flow = column_flow = row

    def separator(self, **_):
        pass

    def label(self, text="", icon="NONE", **_):
        assert icon in self.bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items
        self.said.append(text)

    def prop(self, data, name, **_):
        assert name in data.bl_rna.properties
        self.said.append(name)

    def prop_search(self, data, name, where, items, **_):
        assert name in data.bl_rna.properties and items in where.bl_rna.properties
        self.said.append(name)

    def template_list(self, kind, _, data, items, active, index, **__):
        assert hasattr(self.bpy.types, kind)
        assert items in data.bl_rna.properties and index in active.bl_rna.properties
        self.said.append(items)

    def menu(self, kind, **_):
        assert hasattr(self.bpy.types, kind)
        self.said.append(kind)

    popover = menu

    def operator(self, idname, text="", icon="NONE", **_):
        module, name = idname.split(".")
        properties = getattr(getattr(self.bpy.ops, module), name).get_rna_type().properties
        self.said += [idname, text] if text else [idname]
        return _SetOnly({p.identifier for p in properties})

    def operator_menu_enum(self, idname, name, **_):
        made = self.operator(idname)
        setattr(made, name, None)
        return made


class _SetOnly:
    def __init__(self, names):
        object.__setattr__(self, "names", names)

    def __setattr__(self, name, value):
        assert name in self.names


def draw(bpy, *panels):
    """Text of the panels that are drawn, one after the other; menus and lists are skipped."""
    said = []
    for panel in panels:
        if hasattr(panel, "bl_rna") and not issubclass(panel, bpy.types.Panel):
            continue
        if not hasattr(panel, "poll") or panel.poll(bpy.context):
            panel.draw(SimpleNamespace(layout=Layout(bpy, said)), bpy.context)
    return said
