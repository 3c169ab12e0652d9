"""Rename Object operator: rename an object in the table, with its collection, anchor and point clouds."""

import bpy
from bpy.props import StringProperty

from ..r5dgs_addon.scene import object_names, polls
from ..r5dgs_core import errors


class R5DGS_OT_rename_object(polls.OfObject, bpy.types.Operator):
    """Rename the active object of a loaded scene with its collection, anchor and point clouds"""

    bl_idname = "r5dgs.rename_object"
    bl_label = "Rename Object"
    bl_options = {"REGISTER", "UNDO"}

    new_name: StringProperty(name="Name", description="New name of the object", options={"SKIP_SAVE"})

    def invoke(self, context, event):
        found = self.found(context)
        if found is not None and not self.new_name:
            self.new_name = object_names.names(found[0]).get(found[1], "")
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, context):
        self.layout.prop(self, "new_name")

    def execute(self, context):
        found = self.found(context)
        if found is None or object_names.entry_of(*found) is None:
            self.report({"WARNING"}, "Select an object of a loaded scene first")
            return {"CANCELLED"}
        try:
            name = object_names.rename(*found, self.new_name)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if name != self.new_name.strip():
            self.report({"WARNING"}, f"Renamed to {name}: the given name was taken or too long")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_rename_object,)
