"""*Objects* panel: names, colours and visibility of a scene's objects."""

import bpy

from ..motion import warnings
from ..scene import isolation, loaded_scenes, object_names, object_tint
from . import sidebar

OTHERS = (("r5dgs.duplicate_object", "Duplicate", "DUPLICATE"), ("r5dgs.delete_object", "Delete", "TRASH"))
WIDE = 350  # minimum width of a sidebar that shows the motion in each row (px at UI scale 1)


class R5DGS_UL_objects(bpy.types.UIList):
    """List of a loaded scene's objects."""

    bl_idname = "R5DGS_UL_objects"

    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0):
        own = object_names.clouds(item.id_data, item.object_id)
        row = layout.row(align=True)
        swatch = row.row()
        swatch.ui_units_x = 1.0
        swatch.prop(item, "color", text="")
        row.prop(item, "label", text="", emboss=False)
        if context.region is None or context.region.width > WIDE * context.preferences.system.ui_scale:
            row.label(text=_motion(own))
        if not own:
            row.label(text="deleted")
            return
        if warnings.of_clouds(own):
            row.operator("r5dgs.explain_warning", text="", icon="ERROR", emboss=False).object_id = item.object_id
        count = row.row()
        count.alignment = "RIGHT"
        count.label(text=f"{sum(cloud.r5dgs.count for cloud in own):,}")
        row.prop(item, "hidden", text="", icon="HIDE_ON" if item.hidden else "HIDE_OFF", emboss=False)
        off = item.hidden_in_renders
        icon = "RESTRICT_RENDER_ON" if off else "RESTRICT_RENDER_OFF"
        row.prop(item, "hidden_in_renders", text="", icon=icon, emboss=False)

    def filter_items(self, context, data, name):
        entries, wanted = getattr(data, name), self.filter_name.casefold()
        if not wanted:
            return [], []
        names = object_names.names(data.id_data)
        shown = [wanted in names[entry.object_id].casefold() for entry in entries]
        return [self.bitflag_filter_item if keep else 0 for keep in shown], []


class R5DGS_PT_objects(sidebar.WithScene, bpy.types.Panel):
    """Objects of the scene."""

    bl_idname = "R5DGS_PT_objects"
    bl_label = "Objects"
    manual = "blender"

    def draw(self, context):
        layout = self.layout
        collection = loaded_scenes.active_collection(context)
        state = collection.r5dgs
        layout.template_list("R5DGS_UL_objects", "", state, "table", state, "row", rows=5)
        row = layout.row(align=True)
        row.operator("r5dgs.isolate", text="Isolate Selected", icon="HIDE_ON")
        if isolation.is_isolated(context.scene):
            row.operator("r5dgs.unisolate", icon="HIDE_OFF")
        row = layout.row(align=True)
        for idname, text, icon in OTHERS:
            row.operator(idname, text=text, icon=icon)


class R5DGS_PT_object(sidebar.WithScene, bpy.types.Panel):
    """Name, tint and aliases of the active object."""

    bl_idname = "R5DGS_PT_object"
    bl_parent_id = R5DGS_PT_objects.bl_idname
    bl_label = "Active Object"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        collection = loaded_scenes.active_collection(context)
        return collection is not None and 0 <= collection.r5dgs.row < len(collection.r5dgs.table)

    def draw(self, context):
        collection = loaded_scenes.active_collection(context)
        self.layout.prop(context.scene.r5dgs_words, "click_selects_anchor")
        _draw_active(self.layout, collection, collection.r5dgs.table[collection.r5dgs.row])


def _draw_active(box, collection, entry):
    box.prop(entry, "label", text="Name")
    moves = _motion(object_names.clouds(collection, entry.object_id))
    if moves:
        box.label(text=f"Motion: {moves}", icon="CON_FOLLOWPATH")
    row = box.row(align=True)
    row.prop(entry, "tint")
    row.operator("r5dgs.reset_color", text="", icon="LOOP_BACK")
    if any(object_tint.is_tinted(cloud) for cloud in object_names.clouds(collection, entry.object_id)):
        box.label(text="Tinted in previews, renders and exports", icon="COLOR")
    if entry.caption:
        box.label(text=entry.caption)
    row = box.row()
    row.label(text="Aliases")
    row.operator("r5dgs.add_alias", text="", icon="ADD").object_id = entry.object_id
    for alias in entry.aliases:
        line = box.row(align=True)
        line.label(text=alias.name or "(empty)", icon="SMALL_CAPS")
        action = line.operator("r5dgs.remove_alias", text="", icon="X", emboss=False)
        action.word, action.object_id = alias.name, entry.object_id


def _motion(own) -> str:
    """Name of an object's motion type, or "" if unknown."""
    for cloud in sorted(own, key=lambda cloud: -cloud.r5dgs.count):
        physics = getattr(cloud.parent, "r5dgs_motion", None)
        if physics is not None and "kind" in physics.bl_rna.properties:
            items = physics.bl_rna.properties["kind"].enum_items
            return items[physics.kind].name if physics.kind in items else ""
    return ""


CLASSES = (R5DGS_UL_objects, R5DGS_PT_objects, R5DGS_PT_object)
