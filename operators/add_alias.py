"""Add Alias operator: another word that finds the active object."""

import bpy
from bpy.props import StringProperty

from ..r5dgs_addon.scene import loaded_scenes, object_names, polls


class R5DGS_OT_add_alias(polls.OfObject, bpy.types.Operator):
    """Add another word that finds the active object"""

    bl_idname = "r5dgs.add_alias"
    bl_label = "Add Alias"
    bl_options = {"REGISTER", "UNDO"}

    word: StringProperty(name="Word", description="Word that finds the object, such as 'cup'", options={"SKIP_SAVE"})

    def invoke(self, context, event):
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, context):
        self.layout.prop(self, "word")

    def execute(self, context):
        found = self.found(context)
        entry = None if found is None else object_names.entry_of(*found)
        if entry is None or not loaded_scenes.is_own(found[0]):
            self.report({"WARNING"}, "First select an object of a scene that was loaded into this file")
            return {"CANCELLED"}
        word = self.word.strip()
        if not word:
            self.report({"WARNING"}, "Type a word first")
            return {"CANCELLED"}
        if word in [alias.name for alias in entry.aliases]:
            self.report({"INFO"}, f"'{word}' already finds {object_names.names(found[0])[found[1]]}")
            return {"CANCELLED"}
        entry.aliases.add().name = word
        return {"FINISHED"}


CLASSES = (R5DGS_OT_add_alias,)
