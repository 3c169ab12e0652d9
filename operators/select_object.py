"""Select Object operator: select an object of a loaded scene by its id, used for matches in the sidebar."""

import bpy
from bpy.props import EnumProperty, IntProperty, StringProperty

from ..r5dgs_addon.scene import object_names, polls, selection
from . import select_by_prompt


class R5DGS_OT_select_object(polls.Selects, bpy.types.Operator):
    """Select this object; Shift adds it, Ctrl removes it"""

    bl_idname = "r5dgs.select_object"
    bl_label = "Select Object"
    bl_options = {"REGISTER", "UNDO"}

    scene: StringProperty(
        name="Scene", description="Collection of the object's scene; empty for the active one", options={"SKIP_SAVE"}
    )
    object_id: IntProperty(
        name="Object Id",
        description="Id in the scene's table of objects",
        default=object_names.NOBODY,
        options={"SKIP_SAVE"},
    )
    mode: EnumProperty(
        name="Mode", description="Change of the selection", items=select_by_prompt.MODES, options={"SKIP_SAVE"}
    )

    def invoke(self, context, event):
        if event.shift or event.ctrl:
            self.mode = "ADD" if event.shift else "SUBTRACT"
        return self.execute(context)

    def execute(self, context):
        found = selection.find(context, self.scene, self.object_id)
        if found is None:
            self.report({"WARNING"}, "There is no such object; search again")
            return {"CANCELLED"}
        collection, object_id = found
        name = object_names.names(collection)[object_id]
        if object_id not in object_names.present(collection):
            self.report({"WARNING"}, f"{name} was deleted")
            return {"CANCELLED"}
        missed = selection.select(context, [found], self.mode)
        if missed:
            self.report({"WARNING"}, f"{name}: hidden and therefore not selected: {', '.join(missed)}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_select_object,)
