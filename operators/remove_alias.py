"""Remove Alias: a word that shall not find the active object any more."""

import bpy
from bpy.props import IntProperty, StringProperty

from ..r5dgs_addon import selection, table


class R5DGS_OT_remove_alias(bpy.types.Operator):
    """Remove this word, so that it no longer finds the object"""

    bl_idname = "r5dgs.remove_alias"
    bl_label = "Remove Alias"
    bl_options = {"REGISTER", "UNDO"}

    word: StringProperty(name="Word", description="The word", options={"SKIP_SAVE"})
    scene: StringProperty(name="Scene", description="Collection of the object's scene", options={"SKIP_SAVE"})
    object_id: IntProperty(
        name="Object Id", description="Another object than the active one", default=table.NOBODY, options={"SKIP_SAVE"}
    )

    @classmethod
    def poll(cls, context):
        if not selection.scenes(context):
            cls.poll_message_set("Load an R5DGS scene first")
            return False
        return True

    def execute(self, context):
        found = selection.find(context, self.scene, self.object_id)
        entry = None if found is None else table.entry_of(*found)
        words = [] if entry is None else [alias.name for alias in entry.aliases]
        if entry is None or not table.is_kept(found[0]) or self.word not in words:
            self.report({"WARNING"}, f"No such word to remove: '{self.word}'")
            return {"CANCELLED"}
        entry.aliases.remove(words.index(self.word))
        return {"FINISHED"}


CLASSES = (R5DGS_OT_remove_alias,)
