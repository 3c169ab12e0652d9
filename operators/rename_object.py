"""Rename Object: in the table, and its collection, anchor and clouds with it."""

import bpy
from bpy.props import IntProperty, StringProperty

from ..r5dgs_addon import selection, table
from ..r5dgs_core import errors


class R5DGS_OT_rename_object(bpy.types.Operator):
    """Rename the active object of a loaded scene: its collection, anchor and clouds, and what finds it"""

    bl_idname = "r5dgs.rename_object"
    bl_label = "Rename Object"
    bl_options = {"REGISTER", "UNDO"}

    new_name: StringProperty(name="Name", description="The new name", options={"SKIP_SAVE"})
    scene: StringProperty(name="Scene", description="Collection of the object's scene", options={"SKIP_SAVE"})
    object_id: IntProperty(
        name="Object Id", description="Object to rename instead", default=table.NOBODY, options={"SKIP_SAVE"}
    )

    @classmethod
    def poll(cls, context):
        if not selection.scenes(context):
            cls.poll_message_set("Load an R5DGS scene first")
            return False
        return True

    def invoke(self, context, event):
        found = selection.find(context, self.scene, self.object_id)
        if found is not None and not self.new_name:
            self.new_name = table.names(found[0]).get(found[1], "")
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, context):
        self.layout.prop(self, "new_name")

    def execute(self, context):
        found = selection.find(context, self.scene, self.object_id)
        if found is None or table.entry_of(*found) is None:
            self.report({"WARNING"}, "Select an object of a loaded scene first")
            return {"CANCELLED"}
        try:
            name = table.rename(*found, self.new_name)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if name != self.new_name.strip():
            self.report({"WARNING"}, f"Renamed to {name}: another object has that name, or it was too long")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_rename_object,)
