"""Remove Alias operator: remove a word that finds an object."""

import bpy
from bpy.props import StringProperty

from ..r5dgs_addon.scene import loaded_scenes, object_names, polls


class R5DGS_OT_remove_alias(polls.OfObject, bpy.types.Operator):
    """Remove this word, so that it no longer finds the object"""

    bl_idname = "r5dgs.remove_alias"
    bl_label = "Remove Alias"
    bl_options = {"REGISTER", "UNDO"}

    word: StringProperty(name="Word", description="Word to remove", options={"SKIP_SAVE"})

    def execute(self, context):
        found = self.found(context)
        entry = None if found is None else object_names.entry_of(*found)
        words = [] if entry is None else [alias.name for alias in entry.aliases]
        if entry is None or not loaded_scenes.is_own(found[0]) or self.word not in words:
            self.report({"WARNING"}, f"No such word to remove: '{self.word}'")
            return {"CANCELLED"}
        entry.aliases.remove(words.index(self.word))
        return {"FINISHED"}


CLASSES = (R5DGS_OT_remove_alias,)
